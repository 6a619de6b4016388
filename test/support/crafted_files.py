"""Give every reader of episodes files with valid checksums and invalid content.

    python test/support/crafted_files.py EPISODE COUNT SEED

Lengths, CRCs, indexes and summary of every file are valid; the content is not. The file lies in a
folder of episodes, as a bag or as the leftover of a killed simulator node. The readers are
`fetch_hand_sim episodes list`, `check`, `recover` and `export`, the schedule of `replay_node` and
`load_episodes`. Each has to end with exit code 0, 1 or 2, in lines without
control characters, within CPU_SECONDS of processor time and MEMORY_BYTES of memory, and nothing may
be written outside of the directory. Prints a JSON object with outcomes and costs; ends with 1 at
the first file that breaks a rule, which is kept in the temporary directory.
"""

from __future__ import annotations

import json
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from io import BytesIO, StringIO
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType, IndexType, Writer

from fetch_hand_sim.commands import (
    episodes_check,
    episodes_export,
    episodes_list,
    episodes_recover,
)
from fetch_hand_sim.episode_log import EpisodeReadError, load_episodes, read_episode
from fetch_hand_sim.replay_node.schedule import ReplaySchedule
from msgs_spec.schemas import schema_text
from support import peak_memory, reset_peak_memory

MEMORY_BYTES = 500 * 10**6
CPU_SECONDS = 2.0

# Text of a metadata record where a number, a name or a word is expected.
NUMBERS = (
    'inf',
    '-inf',
    'nan',
    '',
    '-1',
    '0',
    str(2**63),
    str(2**64),
    '1e999',
    '9' * 5000,
    '٣',
    'x',
)
RATES = ('0', '-1', 'nan', 'inf', '1e-300', '1e300', '', '7', '25.0000001', '0x19', 'x')
NAMES = ('', '../../evil', '/etc/passwd', '\x1b]0;owned\x07', '\n', 'x' * 5000, '\x00', '🤖')
FLOATS = (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0, 1e6)
TIMES = (0, 1, 2**63 - 1, 2**63, 2**64 - 1)
QUALITIES = (
    '',
    '[]',
    'x',
    '- 1',
    '- {history: 1}',
    '- &a [x]\n- *a',
    '[' * 1000,
    'a: ' * 500,
    '- !!python/name:os.system',
    '- history: ' + '9' * 4000,
)


@dataclass
class Message:
    """A message to write."""

    topic: str
    time: int
    data: bytes
    sequence: int


@dataclass
class Content:
    """The content of a file, to be changed in any part."""

    metadata: dict[str, str]
    result: dict[str, str]
    types: dict[str, tuple[str, str, str]]
    messages: list[Message]
    attachments: list[tuple[str, bytes]] = field(default_factory=list)
    records: tuple[str, ...] = ('episode', 'episode_result')
    schema_texts: dict[str, str] = field(default_factory=dict)
    encoding: str = 'cdr'
    compression: CompressionType = CompressionType.LZ4
    chunk_size: int = 128 * 1024
    statistics: bool = True
    index: IndexType = IndexType.ALL

    def to_bytes(self) -> bytes:
        stream = BytesIO()
        writer = Writer(
            stream,
            chunk_size=self.chunk_size,
            compression=self.compression,
            use_statistics=self.statistics,
            index_types=self.index,
        )
        writer.start(profile='ros2')
        for name in self.records:
            writer.add_metadata(name, self.result if name == 'episode_result' else self.metadata)
        for name, data in self.attachments:
            writer.add_attachment(0, 0, name, 'text/plain', data)
        channels = {}
        for message in self.messages:
            if message.topic not in channels:
                channels[message.topic] = self._channel(writer, message.topic)
            writer.add_message(
                channels[message.topic], message.time, message.data, message.time, message.sequence
            )
        writer.finish()
        return stream.getvalue()

    def _channel(self, writer: Writer, topic: str) -> int:
        type_name, qos, type_hash = self.types[topic]
        text = self.schema_texts.get(type_name, 'float64 data').encode()
        schema = writer.register_schema(type_name, 'ros2msg', text)
        metadata = {'offered_qos_profiles': qos, 'topic_type_hash': type_hash}
        return writer.register_channel(topic, self.encoding, schema, metadata)


class Crafter:
    """Changes the meaning of a whole episode in one to three ways.

    Args:
        path: The episode.
        seed: Of the changes.
        number: Of the file.
    """

    def __init__(self, path: Path, seed: int, number: int) -> None:
        self.episode = read_episode(path)
        self.number_of_file = number
        self.random = np.random.default_rng([seed, number])
        self.texts = {t.type_name: schema_text(t.type_name) for t in self.episode.topics.values()}
        self.changes = (
            self.number,
            self.rate,
            self.word,
            self.outcome,
            self.lost_key,
            self.many_keys,
            self.other_records,
            self.values,
            self.bytes,
            self.lengths,
            self.strings,
            self.long_messages,
            self.empty_messages,
            self.times,
            self.stamps,
            self.sequences,
            self.lost_topic,
            self.lost_messages,
            self.repeated_messages,
            self.swapped_topics,
            self.renamed_topic,
            self.other_type,
            self.quality,
            self.schema,
            self.many_topics,
            self.goals,
            self.attachment,
            self.layout,
            self.no_messages,
            self.encoding,
        )

    def make(self) -> tuple[str, bytes]:
        content = self.whole()
        chosen = [self.changes[self.number_of_file % len(self.changes)]]
        extra = int(self.random.integers(3))
        chosen += [
            self.changes[int(i)] for i in self.random.integers(len(self.changes), size=extra)
        ]
        for change in chosen:
            change(content)
        return '+'.join(change.__name__ for change in chosen), content.to_bytes()

    def whole(self) -> Content:
        episode = self.episode
        types = {n: (t.type_name, t.qos_yaml, t.type_hash) for n, t in episode.topics.items()}
        messages = [
            Message(name, m.log_time_ns, m.data, m.sequence)
            for name, logged in episode.topics.items()
            for m in logged.messages
        ]
        messages.sort(key=lambda message: message.time)
        return Content(
            dict(episode.metadata), dict(episode.result), types, messages, schema_texts=self.texts
        )

    def pick(self, options):
        return options[int(self.random.integers(len(options)))]

    def some(self, content: Content) -> list[Message]:
        """One message or all of a topic; none of an episode without messages."""
        if not content.messages:
            return []
        message = self.pick(content.messages)
        if self.random.random() < 0.5:
            return [message]
        return [each for each in content.messages if each.topic == message.topic]

    # Records

    def number(self, content: Content) -> None:
        content.metadata[self.pick(('seed', 'episode', 'episode_ticks'))] = self.pick(NUMBERS)

    def rate(self, content: Content) -> None:
        content.metadata['control_hz'] = self.pick(RATES)

    def word(self, content: Content) -> None:
        names = ('task', 'reward_type', 'success_rule', 'robot', 'episode_id', 'mujoco_version')
        words = (*NAMES, '[]', 'FetchPush', 'HandManipulateBlockFull', 'dense', 'paper')
        content.metadata[self.pick(names)] = self.pick(words)

    def outcome(self, content: Content) -> None:
        names = ('steps', 'return', 'success', 'complete', 'reason', 'received_not_logged')
        content.result[self.pick(names)] = self.pick((*NUMBERS, *NAMES, 'true', '{}', '[1]'))

    def lost_key(self, content: Content) -> None:
        record = self.pick((content.metadata, content.result))
        record.pop(self.pick(tuple(record)))

    def many_keys(self, content: Content) -> None:
        record = self.pick((content.metadata, content.result))
        record.update({f'key{i}': 'x' for i in range(int(self.random.integers(1, 100_000)))})

    def other_records(self, content: Content) -> None:
        content.records = self.pick(
            (
                (),
                ('episode',),
                ('episode_result', 'episode'),
                ('episode', 'episode_result', 'episode'),
                ('episode', 'episode_result', *['x'] * 5000),
            )
        )

    # Messages

    def values(self, content: Content) -> None:
        for message in self.some(content):
            data = bytearray(message.data)
            for offset in range(len(data) - 8, 4, -8):
                if self.random.random() < 0.3:
                    struct.pack_into('<d', data, offset, self.pick(FLOATS))
            message.data = bytes(data)

    def bytes(self, content: Content) -> None:
        for message in self.some(content):
            message.data = self.random.bytes(len(message.data))

    def lengths(self, content: Content) -> None:
        """Counts and lengths of strings inside of messages."""
        for message in self.some(content):
            data = bytearray(message.data)
            offset = 4 * int(self.random.integers(1, max(2, len(data) // 4)))
            if offset + 4 <= len(data):
                struct.pack_into('<I', data, offset, int(self.pick((0, 2**16, 2**31, 2**32 - 1))))
            message.data = bytes(data)

    def strings(self, content: Content) -> None:
        """Statuses of very many words, as many as fit."""
        for message in content.messages:
            if message.topic.endswith('status'):
                body = struct.pack('<iI', 0, 0) + struct.pack('<II', 1, 0) + struct.pack('<I', 1)
                message.data = bytes(4) + body + bytes(int(self.random.integers(2**16)))

    def long_messages(self, content: Content) -> None:
        for message in self.some(content):
            message.data += bytes(int(self.pick((1, 2**16, 2**20))))

    def empty_messages(self, content: Content) -> None:
        for message in self.some(content):
            message.data = b''

    def times(self, content: Content) -> None:
        for message in self.some(content):
            message.time = int(self.pick(TIMES))

    def stamps(self, content: Content) -> None:
        """The first eight bytes of a body: seconds and nanoseconds, if it has a stamp."""
        for message in self.some(content):
            if len(message.data) >= 12:
                data = bytearray(message.data)
                data[4:12] = self.random.bytes(8)
                message.data = bytes(data)

    def sequences(self, content: Content) -> None:
        for message in self.some(content):
            message.sequence = int(self.random.integers(2**32))

    def lost_topic(self, content: Content) -> None:
        topic = self.pick(tuple(content.types))
        content.messages = [each for each in content.messages if each.topic != topic]

    def lost_messages(self, content: Content) -> None:
        share = self.random.random()
        content.messages = [each for each in content.messages if self.random.random() < share]

    def repeated_messages(self, content: Content) -> None:
        content.messages += content.messages * int(self.random.integers(1, 50))

    def swapped_topics(self, content: Content) -> None:
        names = list(content.types)
        new = {
            name: names[i]
            for name, i in zip(names, self.random.permutation(len(names)), strict=True)
        }
        for message in content.messages:
            message.topic = new[message.topic]

    # Topics

    def renamed_topic(self, content: Content) -> None:
        old, new = self.pick(tuple(content.types)), self.pick((*NAMES, '/x/y', 'clock', '//'))
        content.types[new] = content.types[old]
        for message in content.messages:
            if message.topic == old:
                message.topic = new

    def other_type(self, content: Content) -> None:
        topic = self.pick(tuple(content.types))
        _, qos, type_hash = content.types[topic]
        types = (*NAMES, 'std_msgs/msg/String', 'std_msgs/Float64', 'sensor_msgs/msg/JointState')
        content.types[topic] = (self.pick(types), qos, type_hash)

    def quality(self, content: Content) -> None:
        for topic, (type_name, _, _) in list(content.types.items()):
            content.types[topic] = (type_name, self.pick(QUALITIES), self.pick(NAMES))

    def schema(self, content: Content) -> None:
        content.schema_texts = {
            name: self.pick(('', 'x' * 70_000, '\x00', 'float64[<=4] x', '=' * 80))
            for name in content.schema_texts
        }

    def many_topics(self, content: Content) -> None:
        type_ = content.types['/clock']
        for number in range(int(self.pick((10, 70, 3000)))):
            content.types[f'/t{number}'] = type_
            content.messages.append(Message(f'/t{number}', 2**40 + number, bytes(12), 0))

    def goals(self, content: Content) -> None:
        """Goals received by the thousand, of any size."""
        type_ = content.types['/desired_goal']
        content.types['/set_goal'] = type_
        goal = next(m.data for m in self.whole().messages if m.topic == '/desired_goal')
        for number in range(int(self.random.integers(4000))):
            data = bytearray(goal)
            struct.pack_into('<d', data, len(data) - 8, float(self.pick((*FLOATS, 1.0, 999.0))))
            time_ns = 1_000_000_100 + number * 17
            content.messages.append(Message('/set_goal', time_ns, bytes(data), number))
        content.messages.sort(key=lambda message: message.time)

    # The file

    def attachment(self, content: Content) -> None:
        size = int(self.pick((0, 10, 2**20, 70 * 2**20)))
        content.attachments.append((self.pick(NAMES), bytes(size)))

    def layout(self, content: Content) -> None:
        content.compression = self.pick(tuple(CompressionType))
        content.chunk_size = int(self.pick((1, 100, 2**26)))
        content.statistics = bool(self.random.integers(2))
        content.index = self.pick((IndexType.ALL, IndexType.NONE, IndexType.METADATA))

    def no_messages(self, content: Content) -> None:
        content.messages = []

    def encoding(self, content: Content) -> None:
        content.encoding = self.pick(('json', '', 'x' * 1000))


class Attack:
    """A directory of episodes with a crafted file in it; around it nothing may change."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.episodes = root / 'a' / 'episodes'
        self.output = root / 'a' / 'output'
        self.tools = {
            'episodes list': lambda: self.command(episodes_list, self.episodes),
            'load_episodes': lambda: load_episodes(self.episodes / 'x', on_skip=lambda _: None),
            'ReplaySchedule': lambda: ReplaySchedule(self.episodes / 'x'),
            'episodes check': lambda: self.command(episodes_check, self.episodes / 'x'),
            'episodes export': self.export,
            'episodes recover': lambda: self.command(episodes_recover, self.episodes),
        }

    def place(self, file: Path) -> None:
        """The file as a bag, and as what a killed robot left."""
        shutil.rmtree(self.root / 'a', ignore_errors=True)
        for directory in ('x', '.y.active'):
            (self.episodes / directory).mkdir(parents=True)
        shutil.copy(file, self.episodes / 'x' / 'x_0.mcap')
        shutil.copy(file, self.episodes / '.y.active' / 'y_0.mcap')

    def command(self, module, *arguments) -> str:
        with redirect_stdout(StringIO()) as output, redirect_stderr(StringIO()) as errors:
            code = module.main([str(argument) for argument in arguments])
        assert code in (0, 1, 2), code
        lines = [*output.getvalue().splitlines(), *errors.getvalue().splitlines()]
        assert all(line.isprintable() and len(line) < 6000 for line in lines), lines
        assert len(errors.getvalue().splitlines()) <= 1, lines
        return f'exit {code}'

    def export(self) -> str:
        arguments = (self.episodes, '--to', 'parquet', '--output', self.output)
        return self.command(episodes_export, *arguments)

    def outcome(self, name: str) -> str:
        try:
            result = self.tools[name]()
        except EpisodeReadError as error:
            assert str(error).isprintable() and len(str(error)) < 6000, repr(error)
            return 'error'
        return result if isinstance(result, str) else 'read'

    def outside(self) -> list[tuple[str, bytes]]:
        return [
            (str(path.relative_to(self.root)), path.read_bytes() if path.is_file() else b'')
            for path in sorted(self.root.rglob('*'))
            if self.episodes not in (path, *path.parents)
            and self.output not in (path, *path.parents)
        ]


def craft(source: Path, seed: int, number: int, file: Path) -> str:
    """Writes a crafted file; in a process of its own, whose memory does not count."""
    kind, data = Crafter(source, seed, number).make()
    file.write_bytes(data)
    return kind


def main() -> int:
    source, count, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    outcomes: Counter[str] = Counter()
    slowest: tuple[float, str] = (0.0, '')
    with tempfile.TemporaryDirectory() as directory, ProcessPoolExecutor(1) as maker:
        file = Path(directory) / 'crafted.mcap'
        attack = Attack(Path(directory) / 'root')
        # Everything is imported and compiled before the limits begin.
        attack.place(next(source.glob('*.mcap')))
        assert {name: attack.outcome(name) for name in attack.tools} == {
            'episodes list': 'exit 0',
            'load_episodes': 'read',
            'ReplaySchedule': 'read',
            'episodes check': 'exit 0',
            'episodes export': 'exit 0',
            'episodes recover': 'exit 0',
        }
        expected = attack.outside()
        before, added = peak_memory(), 0
        maker.submit(int).result()
        mapped = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY_BYTES,) * 2)
        for number in range(count):
            kind = maker.submit(craft, source, seed, number, file).result()
            attack.place(file)
            for name in attack.tools:
                signal.alarm(int(10 * CPU_SECONDS))
                # Counts the memory of this reader only.
                reset_peak_memory()
                resident = peak_memory()
                began = time.process_time()
                try:
                    outcomes[f'{name} {attack.outcome(name)}'] += 1
                    seconds = time.process_time() - began
                    assert seconds < CPU_SECONDS, f'{seconds:.1f} s'
                    assert attack.outside() == expected, 'something was written outside'
                except BaseException:
                    print(f'file {number} ({kind}), {name}', file=sys.stderr)
                    shutil.copy(file, Path(tempfile.gettempdir(), 'crafted_file.mcap'))
                    raise
                added = max(added, peak_memory() - resident)
                slowest = max(slowest, (seconds, f'{name}, file {number} ({kind})'))
                signal.alarm(0)
    report = {
        'outcomes': outcomes,
        'slowest_s': slowest[0],
        'slowest': slowest[1],
        'peak_bytes': before + added,
        'held_bytes': peak_memory(),
    }
    print(json.dumps(report))
    return 0


if __name__ == '__main__':
    sys.exit(main())
