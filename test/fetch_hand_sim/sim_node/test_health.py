"""Reports of the simulator node."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.sim_node.health import Health, Surroundings
from msgs_spec.codecs import message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.topics import DIAGNOSTICS
from node_runtime.diagnostics import Level, encode_reports, next_report

FINE = Surroundings(commanders=['/policy_node'], robots=['/sim_node'], log='episodes')


def report_after(case, surroundings=FINE, seconds=1.0, ticks=25):
    health = Health(case.robot, '/sim_node', case.clock.now)
    health.report(surroundings, case.clock.now)
    for _ in range(ticks):
        case.clock.now += case.robot.wait() if case.robot.wait() < math.inf else 0.0
        case.robot.tick_when_due()
    case.clock.now = max(case.clock.now, 100.0 + seconds)
    return health.report(surroundings, case.clock.now)


def test_report_of_a_healthy_robot(make):
    report = report_after(make(), ticks=26)
    assert report.level is Level.OK, report.message
    assert report.message == 'FetchReach runs, 26.0 ticks per second'
    assert report.values['real time factor'] == '1.040'
    assert report.values['missed ticks'] == '0'
    assert report.values['commanders'] == '/policy_node'
    assert report.values['clock publishers'] == '/sim_node'


@pytest.mark.parametrize(
    ('changes', 'level', 'text'),
    [
        (
            {'clock_publishers': ['/b/sim_node']},
            Level.ERROR,
            '/clock is also published by /b/sim_node; start all robots but one with '
            'publish_clock:=false',
        ),
        (
            {'log': 'logging to episodes has failed', 'has_log_failed': True},
            Level.ERROR,
            'logging to episodes has failed',
        ),
        (
            {'input_problems': ['2 publish commands: /a, /b']},
            Level.WARN,
            '2 publish commands: /a, /b',
        ),
        (
            {'robots': ['/sim_node', '/sim_node'], 'clock_publishers': ['/other']},
            Level.ERROR,
            '2 nodes publish as one robot: /sim_node, /sim_node; give each its own namespace: '
            '--ros-args -r __ns:=/robot2',
        ),
    ],
)
def test_a_report_contains_problems_of_the_surroundings(make, changes, level, text):
    report = report_after(make(), replace(FINE, **changes), ticks=26)
    assert (report.level, report.message) == (level, text)
    message = deserialize(DIAGNOSTICS.type_name, encode_reports(report))
    assert abs(message_stamp(message) - time.time_ns()) < 60e9
    (status,) = message.status
    assert (status.level, status.name, status.message) == (level, '/sim_node', report.message)


def test_other_clocks_matter_only_to_a_robot_that_publishes_one(make):
    others = replace(FINE, clock_publishers=['/b/sim_node'], publishes_clock=False)
    report = report_after(make(), others, ticks=26)
    assert report.level is Level.OK
    assert report.values['clock publishers'] == '/b/sim_node'


@pytest.mark.parametrize(
    ('problem', 'level', 'text'),
    [
        ('missed', Level.WARN, '3 ticks missed'),
        ('late', Level.WARN, '2 late commands: not the answer to the last observation'),
        ('rejected', Level.WARN, '1 commands rejected; 3 values given; allowed: 4'),
        (
            'far out',
            Level.WARN,
            '1 commands clipped from far out of range; y is 100; allowed: -1 ... 1 x 0.05 m',
        ),
        ('stalled', Level.WARN, 'tick 1 of episode 0 waits for a valid command; no node publishes'),
        (
            'elsewhere',
            Level.WARN,
            'no node publishes any; /policy_node waits for a robot on /episode_status',
        ),
        ('stopped', Level.WARN, 'commands have stopped, the robot holds; /policy_node sends none'),
        ('two stopped', Level.WARN, 'the robot holds; /a, /policy_node send none'),
        ('diverged', Level.ERROR, 'the simulation diverged 1 times'),
    ],
)
def test_a_report_contains_problems_of_the_robot(make, monkeypatch, problem, level, text):
    case = make('lockstep' if problem in ('stalled', 'elsewhere') else 'realtime')
    waiting = ['/policy_node waits for a robot on /episode_status']
    surroundings = {
        'stalled': replace(FINE, commanders=[]),
        'elsewhere': replace(FINE, commanders=[], waiting_elsewhere=waiting),
        'two stopped': replace(FINE, commanders=['/a', '/policy_node']),
    }.get(problem, FINE)
    health = Health(case.robot, '/sim_node', case.clock.now)
    case.robot.tick_when_due()
    health.report(surroundings, case.clock.now)
    if problem == 'missed':
        case.clock.now += 0.17
        case.robot.tick_when_due()
    elif problem == 'late':
        case.robot.buffer.accept([0.0] * 4)
        for _ in range(3):
            case.clock.now += case.robot.wait()
            case.robot.tick_when_due()
    elif problem == 'rejected':
        with pytest.raises(ValueError, match='3 values'):
            case.robot.buffer.accept([1.0] * 3)
    elif problem == 'diverged':
        monkeypatch.setattr(case.robot.runner.simulation, 'divergences', 1)
    elif problem == 'far out':
        case.robot.buffer.accept([0.0, 100.0, 0.0, 0.0])
    elif problem in ('stopped', 'two stopped'):
        case.robot.buffer.accept([0.0] * 4)
    case.clock.now += 1.1
    report = health.report(surroundings, case.clock.now)
    assert report.level is level
    assert text in report.message


def test_a_period_with_a_pause_or_another_pace_in_it_is_not_judged(make):
    case = make()
    health = Health(case.robot, '/sim_node', case.clock.now)
    case.robot.tick_when_due()
    health.report(FINE, case.clock.now)

    def pass_a_second():
        for _ in range(25):
            case.clock.now += case.robot.wait()
            case.robot.tick_when_due()
        return health.report(FINE, case.clock.now)

    assert pass_a_second().level is Level.OK
    case.robot.pause(True)
    case.clock.now += 0.5
    case.robot.pause(False)
    assert pass_a_second().level is Level.OK
    case.robot.set_real_time_factor(0.1)
    case.clock.now += 0.3
    case.robot.set_real_time_factor(1.0)
    assert pass_a_second().level is Level.OK
    case.clock.now += 1.0
    assert '0.0 ticks per second instead of 25.0' in health.report(FINE, case.clock.now).message


@pytest.mark.parametrize('factor', [0.01, 0.1])
def test_slow_motion_is_not_called_slow(make, factor):
    """A period contains few ticks, so one more or less is no sign of slowness."""
    case = make()
    health = Health(case.robot, '/sim_node', case.clock.now)
    case.robot.tick_when_due()
    case.robot.set_real_time_factor(factor)
    health.report(FINE, case.clock.now)
    start = case.clock.now
    for second in range(1, 9):
        while case.clock.now + case.robot.wait() < start + second:
            case.clock.now += case.robot.wait()
            case.robot.tick_when_due()
        case.clock.now = start + second
        assert health.report(FINE, case.clock.now).level is Level.OK


def test_a_report_that_came_late_is_followed_by_a_whole_period():
    assert next_report(due=5.0, now=5.1) == 6.0
    assert next_report(due=5.0, now=7.5) == 8.5


@pytest.mark.parametrize('mode', ['realtime', 'lockstep'])
def test_commands_are_not_missing_during_a_pause(make, mode):
    case = make(mode)
    report = Health(case.robot, '/sim_node', case.clock.now).report(FINE, 101.0)
    # The page offers no speed in lockstep.
    assert report.values['mode'] == mode
    case.robot.tick_when_due()
    case.robot.buffer.accept([0.0] * 4)
    case.robot.tick_when_due()
    case.robot.pause(True)
    case.clock.now += 60.0
    case.robot.pause(False)
    assert not case.robot.misses_commands
    case.clock.now += 1.1
    assert case.robot.misses_commands


def test_report_counts_rejections_by_reason(make):
    case = make()
    case.robot.tick()
    for bad in ([0.0] * 3, [np.nan] * 4, [np.inf] * 4):
        with pytest.raises(ValueError, match='allowed: '):
            case.robot.buffer.accept(bad)
    values = Health(case.robot, '/sim_node', case.clock.now).report(FINE, 101.0).values
    assert values['commands rejected'] == '3'
    assert (values['rejected: wrong size'], values['rejected: not finite']) == ('1', '2')
