"""Reports of the simulator node."""

from __future__ import annotations

import time
from types import SimpleNamespace

import pytest

from fetch_hand_sim.sim_node.health import Health
from msgs_spec.codecs import message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.topics import DIAGNOSTICS
from node_runtime.diagnostics import Level, encode_reports, next_report


@pytest.fixture
def health_of():
    def health_of(case, log=None, publishes_clock=True, **graph):
        settings = {'episode_dir': 'episodes', 'publish_clock': publishes_clock}
        node = SimpleNamespace(
            get_fully_qualified_name=lambda: '/sim_node',
            get_parameter=lambda name: SimpleNamespace(value=settings[name]),
            get_logger=lambda: SimpleNamespace(info=case.lines.append, warning=case.lines.append),
        )
        watch = SimpleNamespace(
            inputs=SimpleNamespace(
                commanders=graph.get('commanders', ['/policy_node']),
                problems=lambda: graph.get('problems', []),
            ),
            robots=graph.get('robots', ['/sim_node']),
            clock_publishers=graph.get('clocks', []),
            waiting_elsewhere=lambda: graph.get('waiting', []),
        )
        case.lines = []
        return Health(node, case.robot, watch, log, case.clock.now)

    return health_of


def run_until(case, end):
    while case.clock.now + case.robot.wait() <= end + 1e-9:
        case.clock.now += case.robot.wait()
        case.robot.tick_when_due()
    case.clock.now = end


FAILED_LOG = SimpleNamespace(has_failed=True)
RUNS = 'FetchReach runs, 26.0 ticks per second'
SEVERAL = (
    '2 nodes publish as one robot: /sim_node, /sim_node; give each its own namespace: '
    '--ros-args -r __ns:=/robot2'
)
CLOCKS = (
    '/clock is also published by /b/sim_node; start all robots but one with publish_clock:=false'
)


@pytest.mark.parametrize(
    ('surroundings', 'level', 'text', 'logged'),
    [
        ({}, Level.OK, RUNS, []),
        ({'clocks': ['/b/sim_node']}, Level.ERROR, CLOCKS, [CLOCKS]),
        ({'clocks': ['/b/sim_node'], 'publishes_clock': False}, Level.OK, RUNS, []),
        ({'log': FAILED_LOG}, Level.ERROR, 'logging to episodes has failed', []),
        ({'problems': ['2 commanders']}, Level.WARN, '2 commanders', ['2 commanders']),
        ({'robots': ['/sim_node'] * 2, 'clocks': ['/b']}, Level.ERROR, SEVERAL, [SEVERAL]),
    ],
)
def test_a_report_contains_problems_of_the_surroundings_and_logs_them_once(
    make, health_of, surroundings, level, text, logged
):
    case = make()
    health = health_of(case, **surroundings)
    run_until(case, 101.0)
    report = health.report(case.clock.now)
    assert (report.level, report.message) == (level, text)
    assert report.values['real time factor'] == '1.040'
    assert report.values['missed ticks'] == '0'
    assert report.values['commanders'] == '/policy_node'
    own = ['/sim_node'] if surroundings.get('publishes_clock', True) else []
    clocks = sorted([*own, *surroundings.get('clocks', [])])
    assert report.values['clock publishers'] == ', '.join(clocks)
    message = deserialize(DIAGNOSTICS.type_name, encode_reports(report))
    assert abs(message_stamp(message) - time.time_ns()) < 60e9
    (status,) = message.status
    assert (status.level, status.name, status.message) == (level, '/sim_node', text)
    for second in (102.0, 103.0):
        run_until(case, second)
        assert [spec.name for spec, _ in health.messages(second)] == [
            '/diagnostics',
            'real_time_factor',
        ]
    assert case.lines == ['commands come from /policy_node', *logged]


def miss_ticks(case):
    case.clock.now += 0.17
    case.robot.tick_when_due()


def answer(case, y=0.0):
    case.robot.buffer.accept([0.0, y, 0.0, 0.0])


def answer_once(case):
    answer(case)
    run_until(case, case.clock.now + 0.12)


def answer_far_out(case):
    answer(case, 100.0)


def send_three_values(case):
    with pytest.raises(ValueError, match='3 values'):
        case.robot.buffer.accept([1.0] * 3)


def send_three_values_and_four(case):
    send_three_values(case)
    case.robot.buffer.accept([0.0] * 4)


def diverge(case):
    case.robot.runner.simulation.divergences += 1


ELSEWHERE = {'commanders': [], 'waiting': ['/policy_node waits for a robot on /episode_status']}


@pytest.mark.parametrize(
    ('act', 'graph', 'text'),
    [
        (miss_ticks, {}, '3 ticks missed'),
        (answer_once, {}, '2 late commands: not the answer to the last observation'),
        (send_three_values, {}, '1 commands rejected; 3 values given; allowed: 4'),
        (send_three_values_and_four, {}, '1 commands rejected; 3 values given; allowed: 4'),
        (
            answer_far_out,
            {},
            'commands clipped from far out of range; y is 100; allowed: -1 ... 1',
        ),
        (None, {'commanders': []}, 'tick 1 of episode 0 waits for a valid command; no node publi'),
        (None, ELSEWHERE, 'no node publishes any; /policy_node waits for a robot on /episode_stat'),
        (answer, {}, 'commands have stopped, the robot holds; /policy_node sends none'),
        (answer, {'commanders': ['/a', '/policy_node']}, 'robot holds; /a, /policy_node send none'),
        (diverge, {}, 'the simulation diverged 1 times'),
    ],
)
def test_a_report_contains_problems_of_the_robot(make, health_of, monkeypatch, act, graph, text):
    case = make('lockstep' if act is None else 'realtime')
    simulation = case.robot.runner.simulation
    monkeypatch.setattr(simulation, 'divergences', simulation.divergences)
    health = health_of(case, **graph)
    case.robot.tick_when_due()
    health.report(case.clock.now)
    if act is not None:
        act(case)
    case.clock.now += 1.1
    report = health.report(case.clock.now)
    assert report.level is (Level.ERROR if act is diverge else Level.WARN)
    assert text in report.message
    # The page offers no speed in lockstep.
    assert report.values['mode'] == case.robot.schedule.mode


def test_a_period_with_a_pause_or_another_pace_in_it_is_not_judged(make, health_of):
    case = make()
    health = health_of(case)

    def level_after_a_second():
        run_until(case, case.clock.now + 1.0)
        return health.report(case.clock.now).level

    assert level_after_a_second() is level_after_a_second() is Level.OK
    case.robot.pause(True)
    case.clock.now += 0.5
    case.robot.pause(False)
    assert level_after_a_second() is Level.OK
    case.robot.set_real_time_factor(0.1)
    case.clock.now += 0.3
    case.robot.set_real_time_factor(1.0)
    assert level_after_a_second() is Level.OK
    case.clock.now += 1.0
    assert '0.0 ticks per second instead of 25.0' in health.report(case.clock.now).message


@pytest.mark.parametrize('factor', [0.01, 0.1])
def test_slow_motion_is_not_called_slow(make, health_of, factor):
    """A period contains few ticks, so one more or less is no sign of slowness."""
    case = make()
    health = health_of(case)
    case.robot.tick_when_due()
    case.robot.set_real_time_factor(factor)
    for second in range(9):
        assert health.report(case.clock.now).level is Level.OK
        run_until(case, 101.0 + second)


def test_a_report_that_came_late_is_followed_by_a_whole_period():
    assert next_report(due=5.0, now=5.1) == 6.0
    assert next_report(due=5.0, now=7.5) == 8.5
