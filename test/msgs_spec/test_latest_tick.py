"""All messages of a tick in one."""

from __future__ import annotations

import pytest

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tick import TickEncoder, join_messages, split_messages
from msgs_spec.topics import LATEST_TICK


@pytest.fixture(scope='module')
def messages():
    runner = EpisodeRunner(Simulation('HandManipulateBlockFull', num_threads=1))
    tick = runner.advance(runner.resting_command())
    return TickEncoder(runner.spec).encode(tick, latched=True)


def test_messages_come_back_by_name_in_their_order(messages) -> None:
    parts = split_messages(join_messages(messages))
    assert list(parts.items()) == [(topic.name, data) for topic, data in messages]
    assert len(parts) > 8
    assert split_messages(join_messages([])) == {}


def test_bytes_that_are_no_tick_are_refused(messages) -> None:
    data = join_messages(messages)
    for size in range(0, len(data) - 1, 7):
        with pytest.raises(ValueError, match=r'MultiArray|topic|left'):
            split_messages(data[:size])
    message = deserialize(LATEST_TICK.type_name, data)
    last = message.layout.dim[-1]
    for size, reason in ((last.size + 1, 'bytes left, not'), (last.size - 1, '1 bytes belong to')):
        message.layout.dim[-1].size = size
        with pytest.raises(ValueError, match=reason):
            split_messages(serialize(LATEST_TICK.type_name, message))
