"""Orientations of the fingertips: measured now, identity in episodes of earlier robots."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.robots import FINGERTIPS
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.tick import TickEncoder

TICKS = 6


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


def record(simulation, directory, version):
    """Log the first ticks of an episode as a robot of an interface version publishes them."""
    runner = EpisodeRunner(simulation)
    context = RecordingContext(simulation, with_compiled_model=False)
    encoder = TickEncoder(runner.spec)
    tick = runner.advance(runner.resting_command())
    metadata = context.metadata(tick.status)
    if version == 1:
        del metadata['interface_version']
    writer = EpisodeDirectory(directory).begin('HandReach', 0, metadata, context.attachments)
    for number in range(TICKS):
        if version == 1:
            poses = tick.readings['fingertip_poses'].reshape(5, 7).copy()
            poses[:, 3:] = [1.0, 0.0, 0.0, 0.0]
            readings = {**tick.readings, 'fingertip_poses': poses.ravel()}
            tick = dataclasses.replace(tick, readings=readings)
        writer.write_tick(tick.stamp_ns, encoder.encode(tick, latched=number == 0))
        tick = runner.advance(runner.resting_command())
    return writer.finish({}, 'enough')


def test_episodes_without_orientations_are_checked_and_loaded_as_the_others(tmp_path):
    simulation = Simulation('HandReach', num_threads=1)
    paths = [record(simulation, tmp_path / str(version), version) for version in (1, 2)]
    for path in paths:
        result = check_episode(path)
        assert (result.difference, result.ticks) == (None, TICKS)
    (before,), (now,) = map(load_episodes, paths)
    for name, values in before.observations.items():
        assert values.tobytes() == now.observations[name].tobytes()
