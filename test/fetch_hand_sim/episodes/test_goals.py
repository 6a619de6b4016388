"""Which received goals a robot takes, and that the check of its log takes the same."""

from __future__ import annotations

import json
from contextlib import suppress

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, read_episode
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.episodes.runner import EpisodeRunner, accept_goal
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import build_message
from msgs_spec.schemas import serialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import INTERFACE_VERSION, topic
from support.episode_recorder import Recorder, rested_episode

SECOND = 10**9
GOAL = [1.3, 0.7, 0.6]
SET_GOAL = topic(task_spec('FetchReach'), 'set_goal')


@pytest.fixture(scope='module')
def simulation():
    return Simulation('FetchReach', num_threads=1)


@pytest.fixture
def runner(simulation):
    """At tick 3 of its second episode: the reset was at 1.04 s, now it is 1.16 s."""
    runner = EpisodeRunner(simulation)
    runner.advance(runner.resting_command())
    runner.end_episode()
    for _ in range(4):
        runner.advance(np.zeros(4))
    return runner


def goal_message(values=GOAL, frame='', stamp_ns=0):
    message = build_message(SET_GOAL, stamp_ns, values)
    message.header.frame_id = frame
    return message


@pytest.mark.parametrize('frame', ['', 'world'])
@pytest.mark.parametrize('stamp_ns', [0, 1_040_000_000, 1_100_000_000, 1_160_000_000])
def test_a_goal_of_the_world_and_of_the_running_episode_is_taken(runner, frame, stamp_ns):
    accept_goal(runner, SET_GOAL, goal_message(frame=frame, stamp_ns=stamp_ns))
    assert runner.advance(np.zeros(4)).desired_goal.tolist() == GOAL


@pytest.mark.parametrize(
    ('message', 'reason'),
    [
        (goal_message(frame='base_link'), "frame_id 'base_link' given; allowed: 'world' or empty"),
        (goal_message(frame='x' * 10**4), "frame_id '" + 'x' * 40 + "' given"),
        (goal_message(stamp_ns=SECOND), 'stamp 1.000 s given; allowed: 0, or simulated time of'),
        (goal_message(stamp_ns=2 * SECOND), 'the running episode, 1.040 ... 1.160 s'),
        (goal_message(stamp_ns=-SECOND), 'stamp -1.000 s given'),
        (goal_message([1.0, np.nan, 0.5]), 'finite'),
        (goal_message([1.0, -1e200, 0.5]), r'-1e\+200 given; allowed: -1000 ... 1000'),
    ],
)
def test_what_cannot_be_honoured_is_refused(runner, message, reason):
    before = runner.simulation.observe()['desired_goal']
    with pytest.raises(ValueError, match=reason):
        accept_goal(runner, SET_GOAL, message)
    assert np.array_equal(runner.simulation.observe()['desired_goal'], before)


def test_between_episodes_no_goal_is_taken(runner):
    runner.end_episode()
    with pytest.raises(ValueError, match='no episode is running'):
        accept_goal(runner, SET_GOAL, goal_message())


def record_with_goals(tmp_path, interface_version):
    """Logs an episode with goals on the way, as the robot of an interface version handles them."""
    recorder = Recorder('FetchReach', interface_version=interface_version)
    runner = recorder.runner
    writer = EpisodeDirectory(tmp_path).begin('FetchReach', 0, recorder.metadata())
    goals = {
        5: goal_message([1.0, 1e9, 0.5]),
        10: goal_message([1.2, 0.8, 0.5], 'base_link'),
        15: goal_message([1.3, 0.8, 0.5], 'world', SECOND + 15 * 40_000_000),
        20: goal_message([1.4, 0.8, 0.5], '', SECOND // 2),
        25: goal_message([np.inf, 0.8, 0.5]),
        30: goal_message([1.3, 0.6, 0.5]),
    }
    taken = 0
    for number, (tick, _) in enumerate(rested_episode(runner)):
        writer.write_tick(tick.stamp_ns, recorder.encode(tick))
        if number in goals:
            writer.write_received(SET_GOAL, serialize(SET_GOAL.type_name, goals[number]))
            with suppress(ValueError):
                accept_goal(runner, SET_GOAL, goals[number], reads_header=interface_version != 1)
                taken += 1
    return writer.finish({}), taken


@pytest.mark.parametrize(('interface_version', 'taken'), [(INTERFACE_VERSION, 2), (1, 4)])
def test_the_check_takes_the_goals_that_the_robot_took(tmp_path, interface_version, taken):
    path, count = record_with_goals(tmp_path, interface_version)
    assert count == taken
    assert len(read_episode(path).topics['/set_goal'].messages) == 6
    result = check_episode(path)
    assert result.difference is None, result


def test_a_flood_of_refused_goals_leaves_an_episode_that_can_be_checked(tmp_path):
    recorder = Recorder('FetchReach')
    writer = EpisodeDirectory(tmp_path).begin('FetchReach', 0, recorder.metadata())
    refused = goal_message([1.3, 0.7, 0.5], 'x' * 28_000)
    taken = goal_message([1.3, 0.6, 0.5])
    logged = 0
    for number, (tick, messages) in enumerate(rested_episode(recorder.runner)):
        writer.write_tick(tick.stamp_ns, messages)
        if number == 10:
            data = serialize(SET_GOAL.type_name, refused)
            for _ in range(300):
                logged += writer.write_received(SET_GOAL, data, is_refused=True)
            assert writer.write_received(SET_GOAL, serialize(SET_GOAL.type_name, taken))
            accept_goal(recorder.runner, SET_GOAL, taken)
    path = writer.finish({})
    assert 0 < logged < 40
    omitted = json.loads(read_episode(path).result['received_not_logged'])
    assert omitted == {'set_goal (refused)': 300 - logged}
    result = check_episode(path)
    assert result.difference is None, result
