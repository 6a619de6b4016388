"""Episodes of earlier interface versions; orientations of the fingertips, new in version 2."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.simulation import Simulation
from msgs_spec.robots import FINGERTIPS
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import INTERFACE_VERSION, TopicSpec
from support.episode_recorder import Recorder


@pytest.mark.parametrize('task', ['HandReach', 'HandManipulateBlockFull'])
def test_poses_are_those_of_the_sites(task):
    simulation = Simulation(task, num_envs=2)
    simulation.reset(seed=[3, 4])
    commands = simulation.resting_commands() + 0.2
    for _ in range(3):
        simulation.advance(commands)
    poses = simulation.readings()['fingertip_poses'].reshape(2, 5, 7)
    for index in range(2):
        data = simulation.data(index)
        # Positions and orientations are those of the last substep.
        moved = mujoco.MjData(simulation.model)
        moved.qpos[:], moved.qvel[:] = data.qpos, data.qvel
        mujoco.mj_kinematics(simulation.model, moved)
        for pose, name in zip(poses[index], FINGERTIPS, strict=True):
            site = moved.site(f'robot0:S_{name}')
            np.testing.assert_allclose(pose[:3], site.xpos, atol=2e-3)
            matrix = quaternion_to_matrix(pose[3:])
            np.testing.assert_allclose(matrix, site.xmat.reshape(3, 3), atol=0.05)
            assert abs(pose[3]) < 0.99, 'it has turned'


class FirstRecorder(Recorder):
    """A robot of interface version 1, whose fingertips have no orientation."""

    def __init__(self, task):
        super().__init__(task, interface_version=1)

    def encode(self, tick):
        poses = tick.readings['fingertip_poses'].reshape(5, 7).copy()
        poses[:, 3:] = [1.0, 0.0, 0.0, 0.0]
        readings = {**tick.readings, 'fingertip_poses': poses.ravel()}
        return super().encode(dataclasses.replace(tick, readings=readings))


def test_episodes_without_orientations_are_checked_and_loaded_as_the_others(tmp_path):
    first, second = FirstRecorder('HandReach'), Recorder('HandReach')
    paths = [each.record(EpisodeDirectory(tmp_path)) for each in (first, second)]
    for path in paths:
        assert check_episode(path).difference is None
    (before,), (now,) = map(load_episodes, paths)
    for name, values in before.observations.items():
        assert values.tobytes() == now.observations[name].tobytes()


@pytest.mark.parametrize(('since', 'is_expected'), [(INTERFACE_VERSION, True), (99, False)])
def test_the_check_does_not_expect_topics_that_are_newer_than_the_file(
    tmp_path, monkeypatch, since, is_expected
):
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    added, encode = TopicSpec('added', 'std_msgs/msg/Float64', '', since=since), TickEncoder.encode
    monkeypatch.setattr(TickEncoder, 'encode', lambda *a, **k: [*encode(*a, **k), (added, b'')])
    assert (check_episode(path).difference is not None) == is_expected
