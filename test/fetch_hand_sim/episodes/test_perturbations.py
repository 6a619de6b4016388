"""Pushes: off by default, bounded, one tick long, marked in the log, repeated by its check."""

from __future__ import annotations

import copy

import numpy as np
import pytest

from fetch_hand_sim.commands.episodes_check import main as episodes_check
from fetch_hand_sim.episode_log import EpisodeDirectory, read_episode
from fetch_hand_sim.episodes.recorder import RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner, accept_perturbation, bounded_wrench
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import build_message
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topic
from support.episode_recorder import rested_episode

LIMIT = 10.0


@pytest.fixture(scope='module')
def simulation():
    return Simulation('FetchPush', num_threads=1)


def push(task, body, *values):
    """The message of a push; what is not given is 0."""
    wrench = np.zeros(6)
    wrench[: len(values)] = values
    message = build_message(topic(TASKS[task], 'perturb'), 0, wrench)
    message.header.frame_id = body
    return message


def started(simulation):
    runner = EpisodeRunner(simulation)
    runner.advance(runner.resting_command())
    return runner


def object_path(simulation, pushes):
    """Positions of the object while nothing is commanded; a push before some ticks."""
    runner, found = started(simulation), []
    for number in range(10):
        if number in pushes:
            accept_perturbation(runner, topic(simulation.spec, 'perturb'), pushes[number], LIMIT)
        found.append(runner.advance(runner.resting_command()).readings['object_pose'][:3])
    return np.array(found)


def test_a_push_moves_the_object_during_one_tick_and_nothing_remains(simulation):
    plain = object_path(simulation, {})
    pushed = object_path(simulation, {3: push('FetchPush', 'object0', 0.0, 0.0, LIMIT)})
    np.testing.assert_array_equal(pushed[:3], plain[:3])
    assert np.abs(pushed[4:] - plain[4:]).max() > 1e-5
    np.testing.assert_array_equal(object_path(simulation, {}), plain)


def test_a_copy_of_a_pushed_simulation_is_pushed_during_one_tick_too(simulation):
    simulation.reset(seed=0)
    simulation.perturb('object0', [15.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    twin, still = copy.deepcopy(simulation), np.zeros((1, 4))
    for _ in range(12):
        expected = simulation.step(still).observation['observation']
        np.testing.assert_array_equal(twin.step(still).observation['observation'], expected)
    assert not twin.data(0).xfrc_applied.any()


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach', 'HandManipulatePenFull'])
def test_every_robot_can_be_pushed(task):
    body = 'robot0:palm' if task.startswith('Hand') else 'robot0:gripper_link'
    if task.startswith('HandM'):
        body = 'object'
    simulation = Simulation(task, num_threads=1)
    runner = started(simulation)
    accept_perturbation(runner, topic(simulation.spec, 'perturb'), push(task, body, 5.0), LIMIT)
    joints = runner.advance(runner.resting_command()).readings['joint_states']
    other = started(simulation)
    assert (other.advance(other.resting_command()).readings['joint_states'] != joints).any()


@pytest.mark.parametrize(
    ('message', 'limit', 'line'),
    [
        (push('FetchPush', 'object0', 1.0), 0.0, 'off'),
        (push('FetchPush', 'object0', 10.1), LIMIT, 'allowed: up to 10 N'),
        (push('FetchPush', 'object0', 8.0, 8.0), LIMIT, 'allowed: up to 10 N'),
        (push('FetchPush', 'object0', 0, 0, 0, 1.1), LIMIT, 'and 1 N m'),
        (push('FetchPush', 'object0', np.nan), LIMIT, 'allowed'),
        (push('FetchPush', 'nosuch', 1.0), LIMIT, 'nosuch'),
        (push('FetchPush', '', 1.0), LIMIT, 'no body'),
        (push('FetchPush', 'table0', 1.0), LIMIT, 'table0'),
    ],
)
def test_what_is_refused_moves_nothing(simulation, message, limit, line):
    runner, other = started(simulation), None
    with pytest.raises(ValueError, match=line):
        accept_perturbation(runner, topic(simulation.spec, 'perturb'), message, limit)
    found = runner.advance(runner.resting_command()).readings['object_pose']
    other = started(simulation)
    np.testing.assert_array_equal(
        other.advance(other.resting_command()).readings['object_pose'], found
    )


def test_between_episodes_nothing_is_pushed(simulation):
    runner = EpisodeRunner(simulation)
    with pytest.raises(ValueError, match='no episode'):
        accept_perturbation(
            runner, topic(simulation.spec, 'perturb'), push('FetchPush', 'object0', 1.0), LIMIT
        )


def test_a_logged_push_is_repeated_by_the_check(simulation, tmp_path, capsys):
    context = RecordingContext(simulation, with_compiled_model=False, perturb_limit=LIMIT)
    runner, source = EpisodeRunner(simulation), topic(simulation.spec, 'perturb')
    metadata = context.metadata(runner.waiting_status())
    writer = EpisodeDirectory(tmp_path).begin('FetchPush', 0, metadata)
    wrench = push('FetchPush', 'object0', 3.0, 0.0, 6.0)
    for tick, messages in rested_episode(runner):
        writer.write_tick(tick.stamp_ns, messages)
        if tick.status.tick in (5, 6, 20):
            accept_perturbation(runner, source, wrench, LIMIT)
            writer.write_received(source, serialize(source.type_name, wrench))
    path = writer.finish({})
    episode = read_episode(path)
    assert episode.metadata['perturb_limit'] == '10.0'
    assert len(episode.topics['/perturb'].messages) == 3
    assert episodes_check([str(path)]) == 0, capsys.readouterr()


@pytest.mark.parametrize('seed', range(5))
def test_a_wrench_that_was_bounded_is_taken_and_keeps_its_line(simulation, seed):
    wrench = np.random.default_rng(seed).normal(scale=10.0 ** (seed % 5 - 1), size=6)
    bounded = bounded_wrench(wrench, LIMIT)
    accept_perturbation(
        started(simulation),
        topic(simulation.spec, 'perturb'),
        push('FetchPush', 'object0', *bounded),
        LIMIT,
    )
    share = bounded @ wrench / (wrench @ wrench)
    assert 0.0 < share <= 1.0
    np.testing.assert_allclose(bounded, share * wrench, rtol=1e-12)
    # No weaker than it has to be.
    if share < 1.0:
        force, torque = np.linalg.norm(bounded[:3]), np.linalg.norm(bounded[3:])
        assert max(force / LIMIT, torque / (0.1 * LIMIT)) == pytest.approx(1.0)
