"""One set of limits: nothing a robot can be sent makes a file that its readers refuse."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from mcap.writer import Writer

from fetch_hand_sim.episode_log import (
    Attachment,
    EpisodeLogError,
    EpisodeReadError,
    EpisodeWriter,
    find_leftovers,
    load_episodes,
    read_episode,
    read_summary,
    recover_episode,
)
from fetch_hand_sim.episode_log import records as limits
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.replay_node.schedule import ReplaySchedule
from msgs_spec.schemas import MAX_MESSAGE_BYTES
from msgs_spec.topics import topic

MIB = 2**20
# Topics and sizes of messages that a robot receives while it is paused at its third tick.
FLOODS = {
    'one of 17.6 MB': [('commands', 17_610_916)],
    'eight of 10 MB': [('commands', 10_000_000)] * 8,
    'many of the longest': [('commands', MAX_MESSAGE_BYTES)] * 1000,
    'very many empty': [('commands', 4)] * (limits.MAX_MESSAGES + 10),
    'all topics': [
        (name, size)
        for size in (4, 1000, MAX_MESSAGE_BYTES + 1)
        for name in ('commands', 'set_goal', 'policy_status')
        for _ in range(limits.MAX_RECEIVED_MESSAGES)
    ],
}


def write(directory, recorder, ticks, flood):
    """Logs an episode whose robot is flooded at its third tick."""
    writer = EpisodeWriter(directory, 'episode', recorder.metadata())
    for number, tick in enumerate(ticks):
        assert writer.write_tick(tick.stamp_ns, tick.messages)
        if number == 3:
            for name, size in flood:
                writer.write_received(topic(recorder.spec, name), bytes(size))
        elif tick.command is not None:
            writer.write_received(recorder.commands, tick.command)
    return writer.finish({})


@pytest.mark.parametrize('flood', FLOODS.values(), ids=FLOODS)
def test_no_flood_makes_a_file_that_a_reader_refuses(tmp_path, recorder, ticks, flood):
    path = write(tmp_path, recorder, ticks, flood)
    episode = read_episode(path)
    published = [m for tick in ticks for m in tick.messages]
    counts = {name: len(logged.messages) for name, logged in episode.topics.items()}
    commands = counts.pop('/commands')
    assert sum(counts.values()) >= len(published)
    assert all(counts[f'/{spec.name.lstrip("/")}'] for spec, _ in published)
    # The result counts the rejected messages.
    refused = json.loads(episode.result['received_not_logged'])
    assert commands + refused['commands'] >= len([1 for name, _ in flood if name == 'commands'])
    assert read_summary(path).message_count == commands + sum(counts.values())
    (arrays,) = load_episodes(path)
    assert len(arrays) == 50
    for messages in (logged.messages for logged in episode.topics.values()):
        assert [m.sequence for m in messages] == list(range(len(messages)))


def test_a_flooded_episode_checks_and_replays(tmp_path, recorder, ticks):
    path = write(tmp_path, recorder, ticks, [('commands', 10_000_000)] * 8)
    result = check_episode(path)
    assert result.difference is None and result.ticks == 51
    assert len(ReplaySchedule(path).messages) == sum(len(tick.messages) for tick in ticks)


def test_a_flood_of_commands_leaves_room_for_goals(tmp_path, recorder, ticks):
    flood = [('commands', 24)] * (2 * limits.MAX_RECEIVED_MESSAGES) + [('set_goal', 100)]
    episode = read_episode(write(tmp_path, recorder, ticks, flood))
    assert len(episode.topics['/set_goal'].messages) == 1
    assert json.loads(episode.result['received_not_logged']).keys() == {'commands'}


def test_chunks_are_bounded_too(tmp_path, recorder, ticks):
    """A paused robot flushes what it receives again and again."""
    writer = EpisodeWriter(tmp_path, 'episode', recorder.metadata())
    writer.write_tick(ticks[0].stamp_ns, ticks[0].messages)
    taken = 0
    for name in ('commands', 'set_goal', 'policy_status'):
        for _ in range(limits.MAX_RECEIVED_MESSAGES - 1):
            taken += writer.write_received(topic(recorder.spec, name), bytes(4))
            writer.flush()
    for tick in ticks[1:]:
        assert writer.write_tick(tick.stamp_ns, tick.messages)
    path = writer.finish({})
    assert read_summary(path).message_count == taken + sum(len(tick.messages) for tick in ticks)
    assert limits.MAX_CHUNKS // 2 - 1 <= taken <= limits.MAX_CHUNKS


def test_an_episode_that_is_too_long_is_one_line_and_can_be_recovered(tmp_path, recorder, ticks):
    """A task of another package may last as long as it likes."""
    writer = EpisodeWriter(tmp_path, 'episode', recorder.metadata())
    messages, begun = ticks[1].messages, 0
    with pytest.raises(EpisodeLogError, match='too long for a file of 50000 messages') as caught:
        for begun in range(limits.MAX_MESSAGES):
            writer.write_tick(ticks[0].stamp_ns + begun * 40_000_000, messages)
    assert str(caught.value).count('\n') == 0
    assert begun == limits.MAX_MESSAGES // len(messages)
    assert writer.write_tick(10**15, messages) is False and writer.finish({}) is None
    (leftover,) = find_leftovers(tmp_path)
    assert read_summary(recover_episode(leftover.path)).message_count == limits.MAX_MESSAGES


def test_more_topics_than_readers_accept_are_one_line(tmp_path, ticks):
    writer = EpisodeWriter(tmp_path, 'episode', {})
    spec, data = ticks[0].messages[0]
    messages = [(replace(spec, name=f'topic_{i}'), data) for i in range(limits.MAX_TOPICS + 1)]
    with pytest.raises(EpisodeLogError, match='at most 64 topics'):
        writer.write_tick(1, messages)


def test_what_a_program_gives_is_refused_at_once(tmp_path, recorder, ticks):
    long = {'note': 'x' * (limits.MAX_METADATA_BYTES + 1)}
    with pytest.raises(ValueError, match='bytes of episode metadata; allowed: 65536'):
        EpisodeWriter(tmp_path, 'episode', long)
    attachment = Attachment('a', 'b', bytes(limits.MAX_ATTACHMENT_BYTES + 1))
    with pytest.raises(ValueError, match='bytes attached; allowed'):
        EpisodeWriter(tmp_path, 'episode', {}, [attachment])
    writer = EpisodeWriter(tmp_path, 'episode', {})
    with pytest.raises(ValueError, match='bytes of episode metadata'):
        writer.finish(long)


def test_metadata_as_long_as_allowed_read_back(tmp_path, ticks):
    # Characters that YAML writes ten bytes long.
    metadata = {'task': 'FetchReach', 'note': '\x07' * (limits.MAX_METADATA_BYTES - 100)}
    writer = EpisodeWriter(tmp_path, 'episode', metadata)
    writer.write_tick(ticks[0].stamp_ns, ticks[0].messages)
    path = writer.finish({})
    assert read_episode(path).metadata['note'] == metadata['note']


def bag_of(path, messages, size=0):
    """A valid MCAP file of an episode with equal messages."""
    with path.open('wb') as stream:
        writer = Writer(stream, chunk_size=8 * MIB)
        writer.start(profile='ros2')
        for name in ('episode', 'episode_result'):
            writer.add_metadata(name, {'task': 'FetchReach', 'control_hz': '25.0'})
        schema = writer.register_schema('std_msgs/msg/Float64', 'ros2msg', b'float64 data')
        channel = writer.register_channel('/reward', 'cdr', schema)
        for number in range(messages):
            writer.add_message(channel, number, bytes(size), number)
        writer.finish()
    return path


def test_small_files_of_very_many_messages_cost_little(tmp_path):
    """72 KB of two million empty messages took 10 s and 390 MB."""
    path = bag_of(tmp_path / 'x.mcap', limits.MAX_MESSAGES + 1)
    assert path.stat().st_size < 2 * MIB
    with pytest.raises(EpisodeReadError, match='more than 50000 messages'):
        read_episode(path)


def test_an_episode_without_messages_cannot_be_replayed(tmp_path):
    path = bag_of(tmp_path / 'x.mcap', 0)
    with pytest.raises(EpisodeReadError, match='an episode without messages'):
        ReplaySchedule(path)
    with pytest.raises(EpisodeReadError, match='without messages'):
        check_episode(path)
