"""Received messages."""

from __future__ import annotations

import numpy as np
import pytest

from fetch_hand_sim.sim_node.robot import Receivers
from msgs_spec.codecs import TopicCodec
from msgs_spec.schemas import MAX_MESSAGE_BYTES, message_class, serialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic, topics
from support.hostile_messages import hostile_bytes, introduction

COMMANDS, SET_GOAL, POLICY_STATUS = (
    topic(task_spec('FetchReach'), name) for name in ('commands', 'set_goal', 'policy_status')
)


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach'])
def test_hostile_messages_are_refused_and_counted_and_no_state_is_lost(make, task, hostile_count):
    """Every message is applied or counted, and what is published stays finite."""
    case = make('realtime', task=task, factor=0.0)
    spec = case.robot.runner.spec
    lines = []
    receivers = Receivers(
        case.robot, None, lambda sha256: None, lambda name, line: lines.append(line)
    )
    targets = [each for each in topics(spec) if each.direction == 'subscribed']
    callbacks = {each.name: receivers.callback(each) for each in targets}
    joint_states = TopicCodec(topic(spec, 'joint_states'))
    generator = np.random.default_rng(6)
    sent = dict.fromkeys(callbacks, 0)
    for index in range(hostile_count):
        target = targets[generator.integers(len(targets))]
        callbacks[target.name](hostile_bytes(generator, target))
        sent[target.name] += 1
        if index % 10 == 0:
            case.clock.now += 0.04
            case.robot.tick_when_due()
            tick, messages = case.ticks.pop()
            data = next(data for each, data in messages if each.name == 'joint_states')
            assert np.isfinite(joint_states.decode(data)[1]).all()
            assert np.isfinite(tick.desired_goal).all()
            assert np.isfinite(tick.achieved_goal).all()
    buffer, counters = case.robot.buffer, case.robot.counters
    commands = sent['commands'] + sent.get('joint_commands', 0)
    assert buffer.accepted + buffer.rejected.total() == commands
    assert counters.goals_set + counters.goals_rejected == sent['set_goal']
    assert len(lines) >= buffer.rejected.total() + counters.goals_rejected
    assert buffer.rejected['unreadable'] > 0
    assert min(buffer.accepted, buffer.rejected.total(), counters.goals_rejected) > 0
    assert max(len(line) for line in lines) < 1000
    assert all('\n' not in line for line in lines)
    assert case.robot.runner.simulation.divergences == 0


class Log:
    """Notes what would be logged."""

    def __init__(self):
        self.received, self.refused = [], 0

    def record_received(self, topic, data, *, is_refused):
        self.received.append((topic.name, data))
        self.refused += is_refused


@pytest.fixture
def listening(make):
    """A robot in its first episode, its log, what it warns of and who commands it."""
    case = make()
    case.robot.tick()
    case.log, case.lines, case.commanders = Log(), [], []

    def warn(name, line):
        case.lines.append(f'{name} dropped: {line}')

    case.receivers = Receivers(case.robot, case.log, case.commanders.append, warn)
    return case


def receive(case, spec, message):
    case.receivers.callback(spec)(serialize(spec.type_name, message))


@pytest.mark.parametrize('name', ['commands', 'set_goal', 'policy_status'])
def test_a_message_too_long_for_a_log_is_dropped_before_it_is_read(listening, name):
    spec = topic(task_spec('FetchReach'), name)
    listening.receivers.callback(spec)(bytes(10_000_000))
    assert listening.lines == [f'{name} dropped: 10000000 bytes given; allowed: up to 65536']
    assert listening.log.received == []
    robot = listening.robot
    assert dict(robot.buffer.rejected) == ({'too long': 1} if name == 'commands' else {})
    assert robot.counters.goals_rejected == (name == 'set_goal')


def test_a_message_is_logged_if_it_can_be_read_and_as_short_as_a_log_allows(listening):
    array = message_class(COMMANDS.type_name)
    layout = message_class('std_msgs/msg/MultiArrayLayout')(dim=[], data_offset=0)
    longest = (MAX_MESSAGE_BYTES - 20) // 8
    for size in (4, 3, longest, longest + 1):
        receive(listening, COMMANDS, array(layout=layout, data=np.zeros(size)))
    listening.receivers.callback(COMMANDS)(b'no message')
    assert [len(data) for _, data in listening.log.received] == [52, 44, 20 + 8 * longest]
    assert listening.log.refused == 2
    assert listening.robot.buffer.accepted == 1
    assert dict(listening.robot.buffer.rejected) == {
        'wrong size': 2,
        'too long': 1,
        'unreadable': 1,
    }


def test_policy_status_contains_a_hash_or_nothing(listening):
    for sha256 in ('', 'a' * 64, 'a' * 63, 'x' * 64, '\x1b[31m' * 1000):
        receive(listening, POLICY_STATUS, introduction(sha256))
    receive(listening, POLICY_STATUS, message_without_pairs())
    assert listening.commanders == [None, 'a' * 64, None]
    assert len(listening.lines) == 3
    assert all(line.isprintable() and len(line) < 200 for line in listening.lines)


def message_without_pairs():
    message = introduction('')
    message.status = []
    return message
