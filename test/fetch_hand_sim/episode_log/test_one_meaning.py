"""An episode file means one thing to all readers, or all of them reject it with the reason."""

from __future__ import annotations

import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC, CompressionType

from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeReadError,
    load_episodes,
    read_episode,
    read_summary,
)
from fetch_hand_sim.episodes.checker import check_episode
from fetch_hand_sim.films.recording import load_recording
from fetch_hand_sim.replay_node.schedule import ReplaySchedule
from msgs_spec.schemas import schema_text
from msgs_spec.tasks import TASKS
from policy_node.training.experience.episode_files import read_experience
from support.episode_recorder import Recorder

PYMCAP_CLI = Path(sys.executable).with_name('pymcap-cli')
READERS = [
    read_summary,
    read_episode,
    load_episodes,
    load_recording,
    ReplaySchedule,
    check_episode,
]


@pytest.fixture(scope='module')
def parts(finished):
    return Parts(finished)


def raw(opcode, content):
    """A record of any content."""
    return bytes([opcode]) + struct.pack('<Q', len(content)) + content


def record(content):
    builder = RecordBuilder()
    content.write(builder)
    return builder.end()


def metadata(name, content):
    return record(Metadata(name, content))


def chunk(*records, times=(0, 0)):
    data = b''.join(records)
    return record(Chunk('', data, times[1], times[0], 0, len(data)))


def schema(id, name, definition):
    return record(Schema(id, definition.encode(), 'ros2msg', name))


def channel(id, schema_id, topic, encoding='cdr'):
    return record(Channel(id, topic, encoding, {}, schema_id))


def message(id, log_time, data, publish_time=None, sequence=0):
    publish_time = log_time if publish_time is None else publish_time
    return record(Message(id, log_time, data, publish_time, sequence))


def whole(*data, summary=()):
    """An MCAP file without CRCs."""
    start = MCAP0_MAGIC + HEADER + b''.join(data) + record(DataEnd(0))
    footer = record(Footer(len(start) if summary else 0, 0, 0))
    return start + b''.join(summary) + footer + MCAP0_MAGIC


HEADER = record(Header('ros2', 'test'))


class Parts:
    """The records of an episode, to be put together in other ways."""

    def __init__(self, path):
        self.episode = read_episode(path)
        self.record = metadata('episode', self.episode.metadata)
        self.result = metadata('episode_result', self.episode.result)
        names = sorted({topic.type_name for topic in self.episode.topics.values()})
        self.schema_ids = {name: id for id, name in enumerate(names, start=1)}
        self.schemas = [schema(id, name, schema_text(name)) for name, id in self.schema_ids.items()]
        self.channels, found = [], []
        self.channel_ids = {}
        for id, (name, topic) in enumerate(self.episode.topics.items(), start=1):
            self.channel_ids[name] = id
            self.channels.append(channel(id, self.schema_ids[topic.type_name], name))
            found += [(m.log_time_ns, id, m.data) for m in topic.messages]
        self.rows = sorted(found)
        self.messages = [message(id, time, data) for time, id, data in self.rows]
        self.last_ns = self.rows[-1][0]

    def file(self, *extra, messages=None, schemas=None, channels=None, summary=(), times=(0, 0)):
        definitions = [*(schemas or self.schemas), *(channels or self.channels)]
        content = chunk(*definitions, *(messages or self.messages), times=times)
        return whole(self.record, content, *extra, self.result, summary=summary)

    @property
    def late_reward(self):
        """A message after the last one."""
        id = self.channel_ids['/reward']
        data = [data for _, channel, data in self.rows if channel == id][-1]
        return message(id, self.last_ns + 1, data)

    def with_reward_channel(self, type_name='Float64', topic='/reward', encoding='cdr'):
        """A file whose channel of `/reward` is another one."""
        id = self.channel_ids['/reward']
        changed = channel(id, self.schema_ids[f'std_msgs/msg/{type_name}'], topic, encoding)
        return self.file(channels=[*self.channels[: id - 1], changed, *self.channels[id:]])

    def with_message(self, index, later_ns=0, **changes):
        """A file with another message in place of one."""
        time, id, data = self.rows[index]
        changed = message(id, time + later_ns, data, **changes)
        return self.file(messages=[*self.messages[:index], changed, *self.messages[index + 1 :]])

    def with_episode(self, **changes):
        """A file with changes of the metadata record; None leaves a key out."""
        return self.file().replace(
            self.record, changed_record('episode', self.episode.metadata, changes)
        )

    def with_result(self, **changes):
        """The same for the record of the result."""
        return self.file().replace(
            self.result, changed_record('episode_result', self.episode.result, changes)
        )


def changed_record(name, content, changes):
    return metadata(name, {k: v for k, v in {**content, **changes}.items() if v is not None})


def longer(opcode, records):
    """Records with bytes after their last field."""
    return [raw(opcode, each[9:] + b'x') for each in records]


def a_key_twice(parts):
    result = metadata('episode_result', {'return': '0.0', 'RETURN': '0.0'})
    return whole(parts.record, chunk(), result.replace(b'RETURN', b'return'))


def index_of_a_decoy(parts):
    return parts.file(summary=[record(MetadataIndex(30, 100, 'episode_result'))])


def chunk_index_that_leaves_out(parts):
    first = parts.file()
    start = len(MCAP0_MAGIC + HEADER + parts.record)
    length, *times, size = struct.unpack_from('<QQQQ', first, start + 1)
    index = ChunkIndex(length + 9, start, '', size, times[1], 0, {}, times[0], size)
    return parts.file(parts.late_reward, summary=[record(index)])


def message_index_that_leaves_out(parts):
    first_ns, id, _ = parts.rows[0]
    return parts.file(record(MessageIndex(id, [(first_ns, 0)])))


def with_statistics(parts, count=None, last=None, records=1):
    count, last = count or len(parts.rows), last or parts.last_ns
    found = record(Statistics(0, 0, {}, 0, count, last, parts.rows[0][0], 0, 0))
    return parts.file(summary=[found] * records)


def with_schemas(parts, change):
    """A file whose definitions of messages are changed."""
    schemas = [schema(id, name, change(schema_text(name))) for name, id in parts.schema_ids.items()]
    return parts.file(schemas=schemas)


def with_reward_of_two_channels(parts):
    extra = channel(99, parts.schema_ids['std_msgs/msg/Float64'], '/reward')
    return parts.file(chunk(extra, message(99, parts.last_ns + 1, bytes(12))))


def with_longer_result(parts):
    content = chunk(*parts.schemas, *parts.channels, *parts.messages)
    return whole(parts.record, content, *longer(Opcode.METADATA, [parts.result]))


def with_channels_in_the_summary(parts):
    content = chunk(*parts.schemas, *parts.messages)
    return whole(parts.record, content, parts.result, summary=parts.channels)


# Rows: reason of the rejection, function that makes the file.
AMBIGUOUS = [
    ("2 channels of topic '/reward'", with_reward_of_two_channels),
    ('channel 1 is defined twice', lambda p: p.file(chunk(channel(1, 1, '/zzz')))),
    ('channel 1 is defined twice', lambda p: p.file(summary=[channel(1, 1, '/zzz')])),
    (
        'schema 1 is defined twice',
        lambda p: p.file(chunk(schema(1, 'std_msgs/msg/Bool', 'bool data'))),
    ),
    ('chunk record after the end of the data', lambda p: p.file(summary=[chunk(p.late_reward)])),
    ('metadata record after the end of the data', lambda p: p.file(summary=[p.result])),
    (
        "2 metadata records 'episode_result'",
        lambda p: p.file(metadata('episode_result', {'success': 'true', 'complete': 'true'})),
    ),
    (
        "2 metadata records 'episode': a file of 2 episodes",
        lambda p: p.file(changed_record('episode', p.episode.metadata, {'seed': '1'})),
    ),
    ("key 'return' twice", a_key_twice),
    ('index of the metadata disagrees', index_of_a_decoy),
    ('messages that the chunk indexes leave out', chunk_index_that_leaves_out),
    ('message indexes disagree', message_index_that_leaves_out),
    ('other times than its messages', lambda p: p.file(times=(5, 6))),
    ('statistics disagree', lambda p: with_statistics(p, count=3)),
    ('statistics disagree', lambda p: with_statistics(p, last=2 * p.last_ns)),
    ('two records of statistics', lambda p: with_statistics(p, records=2)),
    ('two messages have the log time', lambda p: p.file(messages=[*p.messages, p.messages[-1]])),
    (
        'channel 77, which is not defined',
        lambda p: p.file(messages=[*p.messages, message(77, p.last_ns + 1, b'')]),
    ),
    ('another definition of', lambda p: with_schemas(p, lambda text: 'string evil')),
    ('another definition of', lambda p: with_schemas(p, '# \x0c'.__add__)),
    ("no topic '/reward' of type 'std_msgs/msg/Bool'", lambda p: p.with_reward_channel('Bool')),
    ("'json'", lambda p: p.with_reward_channel(encoding='json')),
    ('several namespaces', lambda p: p.with_reward_channel(topic='/left/reward')),
    (
        'a schema record is longer than its fields',
        lambda p: p.file(schemas=longer(Opcode.SCHEMA, p.schemas)),
    ),
    (
        'a channel record is longer than its fields',
        lambda p: p.file(channels=longer(Opcode.CHANNEL, p.channels)),
    ),
    ('a metadata record is longer than its fields', with_longer_result),
    ('a record of kind 12 in a chunk', lambda p: p.file(messages=[*p.messages, p.result])),
    (
        'comes before the channel',
        lambda p: p.file(schemas=[*p.schemas, p.messages[0]], messages=p.messages[1:]),
    ),
    ('comes before the channel', with_channels_in_the_summary),
    ('comes before its schema', lambda p: p.file(schemas=p.channels, channels=p.schemas)),
    (
        'header record before the end of the data',
        lambda p: p.file(record(Header('', ''))),
    ),
    (
        'a message is shorter than its header',
        lambda p: p.file(messages=[raw(Opcode.MESSAGE, bytes(2))]),
    ),
    (
        'more than 16 metadata records',
        lambda p: p.file(*(metadata(f'record {number}', {}) for number in range(1000))),
    ),
]


@pytest.mark.parametrize(('reason', 'make'), AMBIGUOUS, ids=[each[0] for each in AMBIGUOUS])
def test_an_ambiguous_file_is_rejected_by_all_readers(parts, tmp_path, reason, make):
    path = tmp_path / 'file.mcap'
    path.write_bytes(make(parts))
    for read in READERS:
        with pytest.raises(EpisodeReadError) as caught:
            read(path)
        assert reason in str(caught.value)
        assert len(str(caught.value)) < 500 and '\n' not in str(caught.value)
    with pytest.raises(ValueError, match='no usable episode'):
        read_experience(path, TASKS['FetchReach'])


# Valid files of other tools


def assert_same(path, original):
    """The file has the messages of the original for all readers, and checks as identical."""
    expected, found = read_episode(original).sorted_messages, read_episode(path).sorted_messages
    assert [row[2:] for row in found.rows()] == [row[2:] for row in expected.rows()]
    (one,), (other,) = load_episodes(original), load_episodes(path)
    assert one.observations['observation'].tobytes() == other.observations['observation'].tobytes()
    assert read_summary(path).message_count == read_summary(original).message_count
    assert len(load_recording(path).frames) == 51
    assert len(ReplaySchedule(path).messages) == len(ReplaySchedule(original).messages)
    result = check_episode(path)
    assert (result.difference, result.ticks) == (None, 51)


def reordered_chunks(parts):
    definitions = (*parts.schemas, *parts.channels)
    halves = chunk(*parts.messages[300:]), chunk(*parts.messages[:300])
    return whole(parts.result, *definitions, *halves, parts.record)


VALID = {
    'without chunks': lambda p: whole(p.record, *p.schemas, *p.channels, *p.messages, p.result),
    'definitions outside': lambda p: whole(
        p.record, *p.schemas, *p.channels, chunk(*p.messages), p.result
    ),
    'reordered in a chunk': lambda p: p.file(messages=p.messages[::-1]),
    'reordered chunks': reordered_chunks,
    'definitions repeated': lambda p: p.file(chunk(*p.schemas, *p.channels), summary=p.channels),
    'statistics': with_statistics,
    'comments': lambda p: with_schemas(
        p, lambda text: '# As ROS has it.\n\n' + text.replace('\n', '  # text\n', 1)
    ),
}


@pytest.mark.parametrize('make', VALID.values(), ids=VALID)
def test_a_file_of_one_meaning_is_read_sorted_by_time(parts, finished, tmp_path, make):
    path = tmp_path / 'file.mcap'
    path.write_bytes(make(parts))
    assert_same(path, finished)


@pytest.mark.parametrize('compression', [CompressionType.NONE, CompressionType.ZSTD])
def test_files_of_other_compressions_are_read(finished, tmp_path, compression, monkeypatch):
    recorder = Recorder('FetchReach')
    monkeypatch.setattr('fetch_hand_sim.episode_log.bag.COMPRESSION', compression)
    original = recorder.record(EpisodeDirectory(tmp_path))
    assert_same(original, finished)


TOOLS = {
    'sort': ['sort', 'IN', '-o', 'OUT'],
    'sort by topic': ['sort', 'IN', '-o', 'OUT', '--order', 'topic'],
    'rechunk': ['rechunk', 'IN', 'OUT'],
    'rechunk by pattern': ['rechunk', 'IN', 'OUT', '--strategy', 'pattern', '--pattern', 'joint'],
    'filter': ['filter', 'IN', 'OUT'],
    'compress': ['compress', 'IN', '-o', 'OUT'],
    'decompress': ['decompress', 'IN', '-o', 'OUT'],
}


# The program takes seconds to start.
@pytest.mark.release
@pytest.mark.parametrize('tool', TOOLS)
def test_files_that_pymcap_rewrote_are_read(finished, tmp_path, tool):
    """`pymcap-cli` is under the GPL: it runs as a program and is never imported."""
    if not PYMCAP_CLI.exists():
        pytest.skip('pymcap-cli is not installed')
    paths = {'IN': finished / f'{finished.name}_0.mcap', 'OUT': tmp_path / 'out.mcap'}
    command = [PYMCAP_CLI, *(paths.get(each, each) for each in TOOLS[tool])]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert run.returncode == 0, run.stdout + run.stderr
    assert_same(paths['OUT'], finished)


# The check


def without_the_last_command(parts):
    id = parts.channel_ids['/applied_command']
    last = max(index for index, row in enumerate(parts.rows) if row[1] == id)
    return parts.file(messages=parts.messages[:last])


def later_command(parts):
    id = parts.channel_ids['/commands']
    return parts.with_message(
        next(i for i, row in enumerate(parts.rows) if row[1] == id), later_ns=5
    )


@pytest.mark.parametrize(
    ('where', 'make'),
    [
        ('metadata episode_ticks', lambda p: p.with_episode(episode_ticks=None)),
        ('metadata joint_order', lambda p: p.with_episode(joint_order='["evil"]')),
        ('episode_result retorn', lambda p: p.with_result(retorn='0')),
        ('episode_result return', lambda p: p.with_result(**{'return': '0.0'})),
        ('episode_result complete', lambda p: p.with_result(complete=None)),
        ('episode_result complete', lambda p: p.with_result(complete='maybe')),
        ('topic', without_the_last_command),
        ('log time of commands', later_command),
        ('publish time of', lambda p: p.with_message(100, publish_time=p.last_ns)),
        ('sequence number of', lambda p: p.with_message(100, sequence=7)),
    ],
)
def test_the_check_compares_everything_that_a_reader_returns(parts, tmp_path, make, where):
    path = tmp_path / 'file.mcap'
    path.write_bytes(make(parts))
    difference = check_episode(path).difference
    assert difference is not None and where in difference.field


# Costs


def test_long_and_repeated_names_make_short_lines(parts, tmp_path):
    path = tmp_path / 'file.mcap'
    long_name = channel(99, 1, '/' + 'x' * 900_000)
    path.write_bytes(parts.file(chunk(long_name)))
    for read in READERS:
        with pytest.raises(EpisodeReadError) as caught:
            read(path)
        assert len(str(caught.value)) < 500
    clock = parts.rows[0]
    times = range(parts.last_ns + 1, parts.last_ns + 40_001)
    path.write_bytes(parts.file(chunk(*(message(clock[1], time, clock[2]) for time in times))))
    try:
        line = str(check_episode(path))
    except EpisodeReadError as error:
        line = str(error)
    assert len(line) < 500


def test_many_small_records_cost_little(parts, tmp_path):
    path = tmp_path / 'file.mcap'
    many = metadata('y', {str(number): '' for number in range(60_000)})
    # The space of a record filled with empty strings.
    empty = raw(Opcode.METADATA, many[9:14] + struct.pack('<I', 2**20 - 104) + bytes(2**20 - 104))
    headers = raw(Opcode.HEADER, bytes(8)) * 250_000
    for extra in ((empty,) * 12, (many,) * 12, (headers,)):
        path.write_bytes(parts.file(*extra))
        began = time.process_time()
        with pytest.raises(EpisodeReadError):
            read_summary(path)
        assert time.process_time() - began < 2.0
