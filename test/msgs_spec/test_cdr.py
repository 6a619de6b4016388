"""`decode` and `decode_many` agree for messages of any writer."""

from __future__ import annotations

import numpy as np
import pytest

from msgs_spec.codecs import (
    CommandCodec,
    LayoutError,
    TopicCodec,
    answered_stamp,
    build_message,
    decode,
    message_stamp,
)
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topic, topics

JOINT_STATES = topic(TASKS['FetchReach'], 'joint_states')


def rows(*messages):
    return np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), -1)


@pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)
def test_all_ways_to_read_give_the_same_bits(task):
    generator = np.random.default_rng(2)
    for spec in topics(task):
        if spec.type_name == 'diagnostic_msgs/msg/DiagnosticArray':
            continue
        codec = TopicCodec(spec)
        vector = generator.normal(size=spec.size) * 10.0 ** generator.integers(-300, 300)
        stamp = int(generator.integers(2**31)) * 10**9 + int(generator.integers(10**9))
        data = serialize(spec.type_name, build_message(spec, stamp, vector))
        assert len(data) == codec.size
        message = deserialize(spec.type_name, data)
        has_stamp = hasattr(message, 'header') or hasattr(message, 'clock')
        expected = (stamp if has_stamp else 0, decode(spec, message).tobytes())
        found_stamp, found = codec.decode(data)
        assert (found_stamp, found.tobytes()) == expected, spec.name
        stamps, vectors = codec.decode_many(rows(data, data))
        assert stamps.tolist() == [expected[0]] * 2
        assert vectors.tobytes() == expected[1] * 2


@pytest.mark.parametrize('stamp', [-1, -(2**31) * 10**9, -1_500_000_000, 0, 2**31 * 10**9 - 1])
def test_a_stamp_means_the_same_to_every_reader(stamp):
    codec = TopicCodec(JOINT_STATES)
    data = codec.encode(stamp, np.zeros(JOINT_STATES.size))
    assert codec.decode(data)[0] == stamp
    assert codec.decode_many(rows(data))[0].tolist() == [stamp]
    assert message_stamp(deserialize(JOINT_STATES.type_name, data)) == stamp


def test_other_layouts_are_read_one_by_one_and_refused_in_bulk():
    vector = np.arange(float(JOINT_STATES.size))
    message = build_message(JOINT_STATES, -5, vector)
    message.header.frame_id = 'somewhere'
    message.name = message.name[::-1]
    for part in ('position', 'velocity', 'effort'):
        setattr(message, part, getattr(message, part)[::-1].copy())
    data = serialize(JOINT_STATES.type_name, message)
    stamp, found = TopicCodec(JOINT_STATES).decode(data)
    assert (stamp, found.tolist()) == (-5, vector.tolist())
    with pytest.raises(LayoutError, match=r'joint_states: \d+ bytes, not \d+'):
        TopicCodec(JOINT_STATES).decode_many(rows(data))


@pytest.mark.parametrize('name', ['joint_states', 'desired_goal', 'commands', 'is_success'])
def test_invalid_bytes_are_rejected_in_one_line(name):
    codec = TopicCodec(topic(TASKS['FetchReach'], name))
    good = codec.encode(1, np.zeros(codec.topic.size))
    for data in (b'', good[:3], good[: codec.size - 1], b'\xff' * codec.size, good + b'\0' * 8):
        with pytest.raises(ValueError) as error:
            codec.decode(data)
        assert '\n' not in str(error.value)


@pytest.mark.parametrize('task', ['FetchReach', 'HandReach'])
@pytest.mark.parametrize('stamp', [0, 1_040_000_000, 2**62])
def test_commands_name_the_observation_they_answer(task, stamp):
    commands = topic(TASKS[task], 'commands')
    values = np.linspace(-1.0, 1.0, commands.size)
    data = CommandCodec(commands).encode(stamp, values)
    message = deserialize(commands.type_name, data)
    assert serialize(commands.type_name, message) == data
    assert answered_stamp(message) == stamp
    assert TopicCodec(commands).decode(data)[1].tolist() == values.tolist()
    plain = deserialize(commands.type_name, TopicCodec(commands).encode(0, values))
    assert answered_stamp(plain) is None


@pytest.mark.parametrize('label', ['', 'answers', 'answers -5', f'answers {"9" * 20}', 'z'])
def test_other_labels_name_no_observation(label):
    commands = topic(TASKS['FetchReach'], 'commands')
    message = deserialize(commands.type_name, CommandCodec(commands).encode(7, np.zeros(4)))
    message.layout.dim[1].label = label
    assert answered_stamp(message) is None
