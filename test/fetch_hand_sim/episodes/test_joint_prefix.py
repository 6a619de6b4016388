"""A robot whose joints are named as in other descriptions of it: on the network, in logs, back."""

from __future__ import annotations

import itertools
import json

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, load_episodes, read_episode
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.films.recording import load_recording
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import decode_status
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.tick import EpisodeStatus, TickEncoder
from policy_node.node.responder import Responder
from policy_node.policies.loading import load_policy
from support.episode_recorder import rested_episode

TICKS = 5


@pytest.fixture(scope='module')
def simulations():
    return {name: Simulation(name, num_threads=1) for name in ('FetchPush', 'HandReach')}


def record(simulation, directory, prefix):
    """Logs the first ticks of an episode; returns its path and the messages of the last one."""
    runner = EpisodeRunner(simulation, joint_prefix=prefix)
    context = RecordingContext(simulation, with_compiled_model=False)
    ticks = list(itertools.islice(rested_episode(runner), TICKS))
    writer = EpisodeDirectory(directory).begin(
        runner.spec.name, 0, context.metadata(ticks[0][0].status), context.attachments
    )
    for tick, messages in ticks:
        writer.write_tick(tick.stamp_ns, messages)
    return writer.finish({}, 'enough'), messages


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach'])
@pytest.mark.parametrize('prefix', ['rh_', '', 'left/'])
def test_logs_of_renamed_joints_are_checked_and_loaded_as_the_others(
    task, prefix, simulations, tmp_path
):
    plain, _ = record(simulations[task], tmp_path / 'plain', JOINT_PREFIX)
    renamed, messages = record(simulations[task], tmp_path / 'renamed', prefix)
    (data,) = (data for spec, data in messages if spec.name == 'joint_states')
    names = deserialize('sensor_msgs/msg/JointState', data).name
    expected = [prefix + name.removeprefix(JOINT_PREFIX) for name in TASKS[task].robot.joints]
    assert names == expected
    metadata = read_episode(renamed).metadata
    assert (metadata['joint_prefix'], json.loads(metadata['joint_order'])) == (prefix, expected)
    assert 'joint_prefix' not in read_episode(plain).metadata
    for path in (plain, renamed):
        result = check_episode(path)
        assert (result.difference, result.ticks) == (None, TICKS)
    (one,), (other,) = load_episodes(plain), load_episodes(renamed)
    assert one.spec is other.spec is TASKS[task]
    for name, values in one.observations.items():
        assert values.tobytes() == other.observations[name].tobytes()
    films = load_recording(plain).frames, load_recording(renamed).frames
    assert len(films[0]) == TICKS
    for mine, its in zip(*films, strict=True):
        np.testing.assert_array_equal(mine.joint_position, its.joint_position)
        np.testing.assert_array_equal(mine.object_pose, its.object_pose)


def test_the_status_contains_an_unusual_joint_prefix(simulations):
    for prefix in (JOINT_PREFIX, 'rh_'):
        runner = EpisodeRunner(simulations['HandReach'], joint_prefix=prefix)
        spec, data = TickEncoder(runner.spec).encode_status(0, runner.waiting_status())
        values = decode_status(deserialize(spec.type_name, data))
        assert ('joint_prefix' in values) == (prefix != JOINT_PREFIX)
        assert EpisodeStatus.from_values(values) == runner.waiting_status()


@pytest.mark.parametrize('task', ['FetchPush', 'HandReach'])
def test_a_policy_answers_a_robot_with_renamed_joints(task, simulations):
    runner = EpisodeRunner(simulations[task], joint_prefix='rh_')
    sent = []

    def send(data):
        sent.append(data)
        return True

    responder = Responder(load_policy('resting', task), runner.waiting_status(), send)
    messages = TickEncoder(runner.spec).encode(runner.advance(runner.resting_command()))
    for spec, data in messages:
        if spec.name in {source.name for source in responder.topics}:
            responder.receive(spec.name, data)
    responder.answer()
    assert (len(sent), responder.unusable) == (1, 0)


def test_named_commands_take_the_names_that_are_published():
    robot = task_spec('HandReach', 'rh_').robot
    buffer = CommandBuffer(robot, 0.5)
    buffer.start_episode(np.zeros(20))
    buffer.accept_named(['rh_FFJ2'], [0.5])
    assert buffer.take()[3] == 0.5
    with pytest.raises(ValueError, match="joint 'robot0:FFJ2' given; allowed: rh_WRJ1"):
        buffer.accept_named(['robot0:FFJ2'], [0.5])
