"""Topics, order and contents of the messages of a tick."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from msgs_spec.codecs import decode, decode_status, message_stamp
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tasks import TASKS
from msgs_spec.tick import EpisodeStatus, TickEncoder, join_messages, split_messages
from msgs_spec.topics import LATEST_TICK, topic, topics
from support.random_ticks import STAMP, episode_status, random_tick, sensed_topics

every_task = pytest.mark.parametrize('task', TASKS.values(), ids=TASKS)

RESULT_TOPICS = ['desired_goal', 'achieved_goal', 'reward', 'is_success', 'applied_command']


def expected_order(task):
    return ['/clock', *sensed_topics(task), *RESULT_TOPICS]


@every_task
def test_a_tick_has_every_number_on_its_topic_in_order_with_one_stamp(task):
    tick, encoder = random_tick(task), TickEncoder(task)
    order = expected_order(task)
    assert [spec.name for spec, _ in encoder.encode(tick)] == order
    messages = encoder.encode(tick, latched=True)
    assert [spec for spec in topics(task) if spec.direction == 'published'] == [
        spec for spec, _ in messages
    ]
    expected = {
        **tick.readings,
        '/clock': [],
        'desired_goal': tick.desired_goal,
        'achieved_goal': tick.achieved_goal,
        'reward': [tick.reward],
        'is_success': [1.0],
        'applied_command': tick.applied_command,
    }
    for spec, data in messages:
        message = deserialize(spec.type_name, data)
        if hasattr(message, 'header') or hasattr(message, 'clock'):
            assert message_stamp(message) == STAMP
        if hasattr(message, 'header'):
            has_no_frame = spec.name in ('joint_states', 'episode_status')
            assert message.header.frame_id == ('' if has_no_frame else 'world')
        if spec.name in order:
            np.testing.assert_array_equal(decode(spec, message), expected.pop(spec.name), spec.name)
    assert not expected
    names = [spec.name for spec in topics(task)]
    assert len(set(names)) == len(names)
    assert [name for name in names if name.startswith(('/', '~'))] == ['/clock']


def test_a_reset_has_neither_reward_nor_command_and_no_reading_is_missing():
    task = TASKS['HandManipulateEggRotate']
    tick = dataclasses.replace(random_tick(task), reward=None, applied_command=None)
    names = {spec.name for spec, _ in TickEncoder(task).encode(tick)}
    assert set(expected_order(task)) - names == {'reward', 'applied_command'}
    del tick.readings['fingertip_poses']
    with pytest.raises(ValueError, match='no fingertip_poses in a tick of HandManipulateEggRotate'):
        TickEncoder(task).encode(tick)


def test_status_survives_exactly():
    task = TASKS['HandReach']
    tick = random_tick(task)
    spec, data = TickEncoder(task).encode(tick, latched=True)[-1]
    values = decode_status(deserialize(spec.type_name, data))
    assert EpisodeStatus.from_values(values | {'later': 'addition'}) == tick.status
    for spelling, is_success in (('true', True), ('1', True), ('0', False)):
        other = EpisodeStatus.from_values(values | {'is_success': spelling})
        assert other.is_success is is_success


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'seed': None}, 'episode_status without seed'),
        ({'seed': 'seven'}, "episode_status with unreadable value: seed='seven'"),
        ({'phase': 'dancing'}, "episode_status with phase 'dancing'; allowed: waiting, reset, "),
        ({'control_hz': '-1'}, 'episode_status with control_hz -1 is not'),
        ({'control_hz': '26'}, 'episode_status with control_hz 26 is not .* nearest: 25 and 26.3'),
        ({'control_hz': 'nan'}, 'episode_status with control_hz nan'),
        ({'is_success': 'yes'}, "episode_status with unreadable value: is_success='yes'"),
        ({'success_rule': 'strict'}, "episode_status with success_rule 'strict'"),
        ({'reward_type': 'x' * 50}, f"episode_status with reward_type '{'x' * 40}'"),
        ({'joint_prefix': 'x' * 65}, 'episode_status with joint_prefix of 65 characters'),
    ],
)
def test_unreadable_status_is_refused(change, message):
    values = episode_status(TASKS['HandReach']).to_values() | change
    values = {key: value for key, value in values.items() if value is not None}
    with pytest.raises(ValueError, match=message):
        EpisodeStatus.from_values(values)


def test_another_robot_is_one_whose_messages_mean_something_else():
    status = episode_status(TASKS['FetchPush'])
    other = dataclasses.replace(status, tick=2, episode=4, reward_type='sparse')
    assert status.is_of_same_robot(other)
    for change in ({'task': 'FetchSlide'}, {'control_hz': 25.0}, {'joint_prefix': 'rh_'}):
        assert not status.is_of_same_robot(dataclasses.replace(status, **change))


def test_an_unknown_topic_is_rejected_by_name():
    with pytest.raises(ValueError, match="FetchReach has no topic 'tf'; allowed: /clock, joint"):
        topic(TASKS['FetchReach'], 'tf')


# `latest_tick`


def latched_messages():
    task = TASKS['HandManipulateBlockFull']
    return TickEncoder(task).encode(random_tick(task), latched=True)


def test_messages_come_back_by_name_in_their_order():
    messages = latched_messages()
    parts = split_messages(join_messages(messages))
    assert list(parts.items()) == [(spec.name, data) for spec, data in messages]
    assert len(parts) > 8
    assert split_messages(join_messages([])) == {}


def test_bytes_that_are_no_tick_are_refused():
    data = join_messages(latched_messages())
    for size in range(0, len(data) - 1, 7):
        with pytest.raises(ValueError, match=r'MultiArray|topic|left'):
            split_messages(data[:size])
    message = deserialize(LATEST_TICK.type_name, data)
    last = message.layout.dim[-1]
    for size, reason in ((last.size + 1, 'bytes left, not'), (last.size - 1, '1 bytes belong to')):
        message.layout.dim[-1].size = size
        with pytest.raises(ValueError, match=reason):
            split_messages(serialize(LATEST_TICK.type_name, message))
