"""The responder of `policy_node`, its commands and reports, without ROS."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.episodes.runner import FIRST_STAMP_NS, EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec, answered_stamp, decode
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tasks import task_spec
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import topic
from node_runtime.diagnostics import Level, Report, encode_reports
from policy_node.node.health import Health, Pace, read_pace
from policy_node.node.responder import Responder, StampJoin
from policy_node.policies.loading import load_policy
from policy_node.policies.policy import LoadedPolicy

REACH = task_spec('FetchReach')


class Wire:
    """A subscriber that can be disconnected."""

    def __init__(self):
        self.sent, self.is_connected = [], True

    def __call__(self, data):
        if self.is_connected:
            self.sent.append(data)
        return self.is_connected


@pytest.fixture(scope='module')
def episode():
    """Status and the messages of a few ticks."""
    runner = EpisodeRunner(Simulation('FetchReach', num_threads=1))
    encoder = TickEncoder(REACH)
    status = runner.waiting_status()
    ticks = [encoder.encode(runner.advance(np.full(4, 0.1))) for _ in range(6)]
    return status, [{spec.name: data for spec, data in messages} for messages in ticks]


@pytest.fixture
def case(episode):
    wire = Wire()
    policy = load_policy('resting', 'FetchReach')
    return Responder(policy, episode[0], wire, lambda: 7.0), wire, episode[1]


@pytest.fixture
def health(case, episode):
    """The health of a robot whose first tick was answered."""
    found = Health('/arm/policy_node')
    found.start(case[0], episode[0], 6.0)
    feed(case[0], case[2][0])
    return found


def receive(responder, tick):
    for source in responder.topics:
        responder.receive(source.name, tick[source.name])


def feed(responder, tick):
    receive(responder, tick)
    responder.answer()


def moved(tick, name, stamp):
    """A message of a tick with another stamp."""
    codec = TopicCodec(topic(REACH, name))
    return codec.encode(stamp, codec.decode(tick[name])[1])


def test_each_tick_gets_one_command_in_any_order(case):
    responder, wire, ticks = case
    for index, tick in enumerate(ticks):
        names = [source.name for source in responder.topics]
        for name in np.random.default_rng(index).permutation(names):
            responder.receive(str(name), tick[str(name)])
        responder.answer()
        feed(responder, tick)  # once more, as a robot in lockstep may send it
    assert len(wire.sent) == len(ticks) == responder.answered
    message = deserialize('std_msgs/msg/Float64MultiArray', wire.sent[0])
    assert decode(topic(REACH, 'commands'), message).tolist() == [0.0] * 4
    stamps = [
        answered_stamp(deserialize('std_msgs/msg/Float64MultiArray', data)) for data in wire.sent
    ]
    assert stamps == [FIRST_STAMP_NS + 40_000_000 * number for number in range(len(ticks))]


def test_a_command_without_a_subscriber_is_sent_once_later(case):
    responder, wire, ticks = case
    wire.is_connected = False
    feed(responder, ticks[0])
    assert wire.sent == []
    wire.is_connected = True
    responder.send_unsent()
    responder.send_unsent()
    assert len(wire.sent) == responder.answered == 1


def test_invalid_state_is_refused_and_the_next_tick_answered(case):
    """Values that no observation needs may be missing, for example efforts."""
    responder, wire, ticks = case
    pose, joints, goal = (
        topic(REACH, name) for name in ('end_effector_pose', 'joint_states', 'desired_goal')
    )

    def changed(tick, source, values):
        stamp, vector = TopicCodec(source).decode(tick[source.name])
        for index, value in values.items():
            vector[index] = value
        return {**tick, source.name: TopicCodec(source).encode(stamp, vector)}

    feed(responder, changed(ticks[0], joints, {-1: math.nan}))
    assert len(wire.sent) == 1

    def in_frame(tick, frame):
        message = deserialize(pose.type_name, tick[pose.name])
        message.header.frame_id = frame
        return {**tick, pose.name: serialize(pose.type_name, message)}

    for bad, line in (
        (changed(ticks[1], pose, {0: math.nan}), 'end_effector_pose'),
        (in_frame(ticks[2], 'base_link'), 'base_link'),
        (
            changed(ticks[3], joints, {len(joints.names) - 1: math.inf}),
            f'joint_states: no finite position of {joints.names[-1]}$',
        ),
        # No observation reads the joints of the base.
        (changed(changed(ticks[4], joints, {0: math.nan}), goal, {0: math.nan}), 'desired_goal'),
    ):
        with pytest.raises(ValueError, match=line):
            feed(responder, bad)
    feed(responder, in_frame(ticks[5], ''))
    assert (responder.unusable, len(wire.sent)) == (4, 2)


def test_hostile_bytes_are_refused_in_one_line_and_counted(case, hostile_count):
    responder, wire, ticks = case
    generator = np.random.default_rng(3)
    names = [source.name for source in responder.topics]
    refused = 0
    for _ in range(hostile_count):
        name = names[generator.integers(len(names))]
        data = bytearray(ticks[generator.integers(len(ticks))][name])
        for _ in range(generator.integers(0, 6)):
            data[generator.integers(len(data))] = generator.integers(256)
        if generator.random() < 0.2:
            data = data[: generator.integers(len(data))]
        elif generator.random() < 0.1:
            data += bytes(generator.integers(0, 256, generator.integers(1, 2000)).tolist())
        try:
            responder.receive(name, bytes(data))
            responder.answer()
        except ValueError as error:
            refused += 1
            assert len(str(error)) < 1000
    assert responder.unusable == refused > hostile_count / 10
    sent = {tuple(deserialize('std_msgs/msg/Float64MultiArray', data).data) for data in wire.sent}
    assert sent <= {(0.0,) * 4}
    responder.forget()
    before = responder.answered
    feed(responder, ticks[-1])
    assert responder.answered == before + 1


def test_join_keeps_a_bounded_number_of_incomplete_stamps():
    join = StampJoin(['a', 'b'])
    for stamp in range(10_000):
        assert join.add('a', stamp, np.zeros(1)) is None
    assert join.dropped == 10_000 - 8


def test_an_earlier_stamp_is_late_for_a_while_or_a_restart():
    now, second = [0.0], 10**9
    join = StampJoin(['a'], clock=lambda: now[0])
    late, last = 5 * second - 40_000_000, 5 * second
    for now[0], stamp, is_complete in (
        (0.0, second, True),
        (0.0, 2 * 10**9 * second, True),
        # Far back is a restart at once; shortly before the last stamp only later.
        (0.0, last, True),
        (0.0, late, False),
        (1.5, last, False),
        (1.5, late, True),
        (1.5, last, True),
        (1.5, late, False),
    ):
        assert (join.add('a', stamp, np.zeros(1)) is not None) == is_complete, (now, stamp)
    join.forget()
    assert join.add('a', late, np.zeros(1)) is not None


def test_a_policy_of_another_rate_is_refused(episode):
    status = replace(episode[0], control_hz=50.0)
    with pytest.raises(ValueError, match='25 Hz; the robot runs at 50 Hz'):
        Responder(load_policy('FetchReach'), status, Wire())


def test_a_policy_that_fails_once_answers_the_next_tick(case, episode):
    class Moody:
        calls = 0

        def predict(self, observation, *, deterministic=True):
            self.calls += 1
            if self.calls == 1:
                raise RuntimeError('INVALID_ARGUMENT: a node\nof the graph')
            return np.zeros(4), None

    _, wire, ticks = case
    moody = LoadedPolicy(Moody(), 'FetchReach', 'actor moody.onnx')
    now = [7.0]
    responder = Responder(moody, episode[0], wire, lambda: now[0])
    with pytest.raises(ValueError, match=r'moody.onnx .*INVALID_ARGUMENT: a node of'):
        feed(responder, ticks[0])
    assert (len(wire.sent), responder.failed, responder.unusable) == (0, 1, 0)
    health = Health('/policy_node')
    health.start(responder, episode[0], 6.0)
    report = health.report(7.0, 1)
    assert report.level == Level.ERROR
    assert 'moody.onnx fails: RuntimeError: INVALID_ARGUMENT: a node of the graph' in report.message
    # In lockstep the robot waits for this answer.
    now[0] = 7.9
    responder.answer()
    assert wire.sent == []
    now[0] = 8.0
    responder.answer()
    responder.answer()
    assert (len(wire.sent), responder.failed) == (1, 1)
    feed(responder, ticks[0])
    feed(responder, ticks[1])
    assert len(wire.sent) == 2
    assert health.report(8.0, 1).level == Level.OK


def test_only_the_newest_waiting_tick_is_answered(case):
    responder, wire, ticks = case
    for tick in ticks:
        receive(responder, tick)
    assert responder.is_due
    responder.answer()
    assert not responder.is_due
    responder.answer()
    assert len(wire.sent) == 1


@pytest.mark.parametrize('stamp', [0, 10**18])
def test_a_second_publisher_of_a_topic_does_not_stop_the_policy(case, stamp):
    """With a stamp of 0, as `ros2 topic pub` gives, or of wall time."""
    responder, wire, ticks = case
    second = 10**9
    for number, tick in enumerate(ticks):
        at = (100 * second) + number * 40_000_000
        for source in responder.topics:
            responder.receive(source.name, moved(tick, source.name, at))
            responder.receive('desired_goal', moved(tick, 'desired_goal', stamp + number))
        responder.answer()
    assert len(wire.sent) == len(ticks)


def test_two_robots_that_publish_in_turn_are_reported_within_two_seconds(case, health):
    responder, _, ticks = case
    health.report(7.0, 1)
    publishers = {'/joint_states': 2}
    names = [source.name for source in responder.topics]
    for name in names:
        # A robot that was killed and its successor.
        responder.receive(name, moved(ticks[0], name, 10**12))
        responder.receive(name, moved(ticks[0], name, 10**9))
    assert '2 robots' not in health.report(8.0, 2, publishers=publishers).message
    for step in range(3):
        for name in names:
            responder.receive(name, moved(ticks[0], name, 10**12 + step))
            responder.receive(name, moved(ticks[0], name, 10**9 + step))
    assert '2 robots publish here' in health.report(9.0, 2, publishers=publishers).message


def test_the_report_names_the_problem(case, health):
    responder, _, ticks = case
    health.report(7.0, 1)
    feed(responder, ticks[1])
    report = health.report(8.0, 1)
    assert (report.level, report.message) == (Level.OK, 'FetchReach: 1.0 commands per second')
    report = health.report(12.0, 1)
    assert report.message == 'no state: the last one is 5 s old'
    assert health.news(report) == ['no state: the last one is 5 s old']
    assert health.news(health.report(13.0, 1)) == []
    for _ in range(3):
        responder.inference.add(0.1)
    late = 'slow inference: 100.000 ms, a tick is 40.0 ms'
    assert late in health.report(14.0, 1).message, 'without a pace it is real time'
    assert 'no robot publishes episode_status' in health.report(15.0, 0).message
    health.stop()
    assert health.report(7.0, 0).message == 'waits for a robot'
    report = health.report(7.0, 0, elsewhere=['/arm1', '/arm2'])
    assert report.message == (
        'no robot here: found in /arm1, /arm2; join it with --ros-args -r __ns:=/arm1'
    )
    assert health.news(report) and not health.news(health.report(7.0, 0, elsewhere=['/arm1']))


def test_a_restarted_robot_counts_once_and_two_robots_count_twice():
    health = Health('/policy_node')
    health.report(5.0, 1)
    # The graph lists a killed robot for up to 20 s.
    assert [health.report(5.0 + seconds, 2).level for seconds in range(1, 21)] == [Level.OK] * 20
    assert health.report(26.0, 1).level == Level.OK
    assert health.report(27.0, 2).level == Level.OK
    assert '2 robots publish here' in health.report(52.0, 2).message
    assert '2 robots publish here' in Health('/policy_node').report(5.0, 2).message


def test_a_robot_in_slow_motion_is_not_silent(case, episode):
    (_, wire, ticks), status, now = case, episode[0], [0.0]
    policy = load_policy('resting', 'FetchReach')
    responder, health = Responder(policy, status, wire, lambda: now[0]), Health('/policy_node')
    health.start(responder, status, 0.0)
    for tick in ticks:
        feed(responder, tick)
        for _ in range(4):
            now[0] += 1.0
            assert health.report(now[0], 1).level == Level.OK
    assert health.report(now[0] + 5.0, 1).message == 'no state: the last one is 9 s old'


def diagnostics(*reports):
    return deserialize('diagnostic_msgs/msg/DiagnosticArray', encode_reports(*reports))


def test_a_paused_robot_is_not_silent(health):
    message = diagnostics(Report('/arm/sim_node', 'FetchReach', {'paused': 'True'}, 'is paused'))
    pace = read_pace(message, '/arm')
    assert pace and pace.is_paused
    assert read_pace(message, '/') is None and read_pace(message, '/arm2') is None
    report = health.report(30.0, 1, pace)
    assert (report.level, report.message) == (Level.OK, 'FetchReach: the robot is paused')
    assert health.report(31.0, 1).level == Level.WARN


@pytest.mark.parametrize(
    ('values', 'period'),
    [
        ({'mode': 'lockstep', 'rate asked (Hz)': '-'}, math.inf),
        ({'mode': 'realtime', 'rate asked (Hz)': '5.00'}, 0.2),
        ({'mode': 'realtime', 'rate asked (Hz)': '100.00'}, 0.01),
        ({'mode': 'realtime', 'rate asked (Hz)': '-'}, 0.0),
        ({'rate asked (Hz)': '0.00'}, 0.0),
    ],
)
def test_inference_is_slow_relative_to_the_pace_of_the_robot(case, health, values, period):
    for _ in range(2):
        case[0].inference.add(0.06)
    report = Report('/sim_node', 'FetchReach', {'paused': 'False', **values}, 'runs')
    pace = read_pace(diagnostics(report), '/')
    assert pace == Pace(is_paused=False, period=period)
    message = health.report(8.0, 1, pace).message
    late = 'slow inference: 60.000 ms, a tick is 10.0 ms; commands come late'
    assert (message == late) == (period == 0.01), message


@pytest.mark.parametrize('status_first', [True, False])
def test_a_policy_is_reset_between_episodes(status_first: bool) -> None:
    """After the first tick of an episode the memory contains only this tick."""
    runner = EpisodeRunner(Simulation('FetchReach', num_threads=1))
    encoder = TickEncoder(REACH)
    responder = Responder(load_policy('FetchReach_robust'), runner.waiting_status(), Wire())

    def play(phase_is_told: bool) -> None:
        tick = runner.advance(np.full(4, 0.1))
        messages = {spec.name: data for spec, data in encoder.encode(tick)}
        if phase_is_told and status_first:
            responder.note_phase(tick.status.phase, tick.stamp_ns)
        feed(responder, messages)
        if phase_is_told and not status_first:
            responder.note_phase(tick.status.phase, tick.stamp_ns)

    for _ in range(5):
        play(phase_is_told=True)
    assert np.count_nonzero(responder._state) == 16
    runner.end_episode()
    play(phase_is_told=True)
    assert np.count_nonzero(responder._state) == 4
    play(phase_is_told=True)
    assert np.count_nonzero(responder._state) == 8
