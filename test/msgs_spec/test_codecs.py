"""Bytes and vectors of every topic against rosbags, rclpy and mcap-ros2-support."""

from __future__ import annotations

import struct
from functools import partial
from importlib import import_module

import numpy as np
import pytest

from msgs_spec.codecs import (
    CommandCodec,
    TopicCodec,
    answered_stamp,
    build_message,
    build_status,
    decode,
    decode_status,
    message_stamp,
)
from msgs_spec.schemas import deserialize, message_class, serialize
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topic, topics

STAMP = 2**31 * 10**9 - 1
STATUS = topic(TASKS['FetchReach'], 'episode_status')
# Equal topics of several tasks once.
VECTOR_TOPICS = list(
    dict.fromkeys(
        spec
        for task in TASKS.values()
        for spec in topics(task)
        if spec.type_name != STATUS.type_name
    )
)
IDS = [f'{spec.name}-{spec.type_name.rsplit("/", 1)[1]}{spec.size}' for spec in VECTOR_TOPICS]
every_topic = pytest.mark.parametrize('spec', VECTOR_TOPICS, ids=IDS)


def random_vector(spec, seed=0):
    if spec.type_name == 'std_msgs/msg/Bool':
        return np.array([float(seed % 2)])
    return np.random.default_rng(seed).normal(size=spec.size)


def rows(*messages):
    return np.frombuffer(b''.join(messages), np.uint8).reshape(len(messages), -1)


def ros_class(type_name):
    pytest.importorskip('rclpy')
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


@every_topic
def test_all_ways_to_write_and_read_give_the_same_bits(spec):
    codec = TopicCodec(spec)
    for seed, stamp in enumerate((-(2**31) * 10**9, -1, 0, 1, 999_999_999, 10**9, STAMP)):
        vector = random_vector(spec, seed)
        if spec.type_name != 'std_msgs/msg/Bool':
            vector *= 10.0 ** (100 * seed - 300)
        data = serialize(spec.type_name, build_message(spec, stamp, vector))
        assert codec.encode(stamp, vector) == data
        message = deserialize(spec.type_name, data)
        has_stamp = hasattr(message, 'header') or hasattr(message, 'clock')
        expected = (stamp if has_stamp else 0, decode(spec, message).tobytes())
        assert not has_stamp or message_stamp(message) == stamp
        found_stamp, found = codec.decode(data)
        assert (found_stamp, found.tobytes()) == expected
        stamps, vectors = codec.decode_many(rows(data, data))
        assert stamps.tolist() == [expected[0]] * 2
        assert vectors.tobytes() == expected[1] * 2


@every_topic
def test_rclpy_reads_the_bytes_and_writes_the_same_fields(spec):
    serialization = pytest.importorskip('rclpy.serialization')
    vector = random_vector(spec, seed=1)
    data = TopicCodec(spec).encode(STAMP, vector)
    message = serialization.deserialize_message(data, ros_class(spec.type_name))
    np.testing.assert_array_equal(decode(spec, message), vector)
    if hasattr(message, 'header') or hasattr(message, 'clock'):
        assert message_stamp(message) == STAMP
    if hasattr(message, 'header'):
        assert message.header.frame_id == spec.frame
    theirs = serialization.serialize_message(message)
    assert len(data) <= len(theirs) <= len(data) + 8
    # rclpy leaves the padding uninitialised; serialising once more zeroes it.
    fields = deserialize(spec.type_name, theirs[: len(data)])
    assert serialize(spec.type_name, fields) == data


@every_topic
def test_wrong_size_is_refused_with_both_sizes(spec):
    message = rf'{spec.name}: {spec.size + 1} values given; allowed: {spec.size}$'
    with pytest.raises(ValueError, match=message):
        TopicCodec(spec).encode(0, np.zeros(spec.size + 1))
    # A single number must not spread over all places.
    if spec.size > 1:
        with pytest.raises(ValueError, match='given; allowed'):
            TopicCodec(spec).encode(0, np.zeros(1))


def test_quaternions_are_xyzw_in_messages_and_wxyz_in_vectors():
    spec = topic(TASKS['FetchPush'], 'object_pose')
    message = build_message(spec, 0, [1, 2, 3, 0.1, 0.2, 0.3, 0.4])
    turn = message.pose.orientation
    assert (turn.w, turn.x, turn.y, turn.z) == (0.1, 0.2, 0.3, 0.4)
    spec = topic(TASKS['HandManipulateEggFull'], 'object_joint')
    message = build_message(spec, 0, [1, 2, 3, 0.1, 0.2, 0.3, 0.4, 5, 6, 7, 8, 9, 10])
    turn = message.transforms[0].rotation
    assert (turn.w, turn.x, turn.y, turn.z) == (0.1, 0.2, 0.3, 0.4)
    assert message.joint_names == ['object:joint']


def test_joints_that_are_not_given_are_nan():
    spec = topic(TASKS['HandReach'], 'joint_commands')
    message = message_class(spec.type_name)(
        header=build_message(spec, 0, np.zeros(20)).header,
        name=['robot0:THJ0', 'robot0:WRJ1'],
        position=np.array([-1.0, 0.1]),
        velocity=np.zeros(0),
        effort=np.zeros(0),
    )
    expected = np.full(20, np.nan)
    expected[[-1, 0]] = -1.0, 0.1
    np.testing.assert_array_equal(decode(spec, message), expected)


@pytest.mark.parametrize(
    ('name', 'attribute', 'given', 'expected'),
    [
        ('commands', 'data', np.zeros(3), r'commands: 3 values given; allowed: 20'),
        (
            'fingertip_poses',
            'poses',
            [],
            'fingertip_poses: 0 poses given; allowed: 5, in the order fftip, ',
        ),
        ('joint_states', 'velocity', np.zeros(3), '3 values given for 24 names'),
        ('object_joint', 'joint_names', ['pen'], r"object_joint: joints \['pen'\] given; allowed"),
        ('object_joint', 'twist', [], r'object_joint: 1 transforms and 0 twists given'),
    ],
)
def test_message_of_another_size_is_refused(name, attribute, given, expected):
    spec = topic(TASKS['HandManipulatePenFull'], name)
    message = build_message(spec, 0, random_vector(spec))
    setattr(message, attribute, given)
    with pytest.raises(ValueError, match=expected):
        decode(spec, message)


def test_status_round_trip_through_rclpy():
    values = {'task': 'FetchReach', 'seed': '7', 'note': 'Größe ✓', 'empty': ''}
    message = build_status(STATUS, STAMP, 'episode', values)
    data = serialize(STATUS.type_name, message)
    assert decode_status(deserialize(STATUS.type_name, data)) == values
    serialization = pytest.importorskip('rclpy.serialization')
    received = serialization.deserialize_message(data, ros_class(STATUS.type_name))
    assert decode_status(received) == values
    assert received.status[0].name == 'episode'
    assert received.status[0].level == b'\x00'
    assert message_stamp(received) == STAMP


def test_other_layouts_are_read_one_by_one_and_refused_in_bulk():
    spec = topic(TASKS['FetchReach'], 'joint_states')
    vector = np.arange(float(spec.size))
    message = build_message(spec, -5, vector)
    message.header.frame_id = 'somewhere'
    message.name = message.name[::-1]
    for part in ('position', 'velocity', 'effort'):
        setattr(message, part, getattr(message, part)[::-1].copy())
    data = serialize(spec.type_name, message)
    stamp, found = TopicCodec(spec).decode(data)
    assert (stamp, found.tolist()) == (-5, vector.tolist())
    with pytest.raises(ValueError, match='joint_states'):
        TopicCodec(spec).decode_many(rows(data))


def test_too_many_nanoseconds_are_refused_alone_and_in_bulk():
    codec = TopicCodec(topic(TASKS['FetchReach'], 'joint_states'))
    data = codec.encode(7, np.zeros(codec.topic.size))
    at = data.index(struct.pack('<iI', 0, 7)) + 4
    wrong = data[:at] + struct.pack('<I', 10**9) + data[at + 4 :]
    with pytest.raises(ValueError, match='nanosec 1000000000'):
        codec.decode(wrong)
    with pytest.raises(ValueError, match='nanoseconds'):
        codec.decode_many(rows(data, wrong))


@pytest.mark.parametrize('name', ['joint_states', 'desired_goal', 'commands', 'is_success'])
def test_invalid_bytes_are_rejected_in_one_line(name):
    codec = TopicCodec(topic(TASKS['FetchReach'], name))
    good = codec.encode(1, np.zeros(codec.topic.size))
    for data in (b'', good[:3], good[: codec.size - 1], b'\xff' * codec.size, good + b'\0' * 8):
        with pytest.raises(ValueError) as error:
            codec.decode(data)
        assert '\n' not in str(error.value)


@pytest.mark.parametrize('seconds', [2**31, -(2**31) - 1])
def test_a_stamp_beyond_int32_seconds_is_invalid(seconds):
    spec, values = topic(TASKS['FetchReach'], 'desired_goal'), np.zeros(3)
    for encode in (TopicCodec(spec).encode, partial(build_message, spec)):
        with pytest.raises(ValueError, match=f'stamp of {seconds} s; allowed in ROS'):
            encode(seconds * 10**9, values)


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
    (dimension,) = plain.layout.dim
    labels = ','.join(part.name for part in commands.layout)
    assert (dimension.label, dimension.size) == (labels, commands.size)


@pytest.mark.parametrize('label', ['', 'answers', 'answers -5', f'answers {"9" * 20}', 'z'])
def test_other_labels_name_no_observation(label):
    commands = topic(TASKS['FetchReach'], 'commands')
    message = deserialize(commands.type_name, CommandCodec(commands).encode(7, np.zeros(4)))
    message.layout.dim[1].label = label
    assert answered_stamp(message) is None
