"""Raw messages of an episode as arrays of bytes, topic by topic, a whole file at a time."""

from __future__ import annotations

import mmap
import struct
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from fetch_hand_sim.episode_log.errors import EpisodeReadError
from fetch_hand_sim.episode_log.limits import (
    MAX_MESSAGES,
    MAX_METADATA_RECORDS,
    MAX_RECORD_BYTES,
    MAX_RECORDS,
    MAX_UNPACKED_BYTES,
)
from fetch_hand_sim.episode_log.reader import mcap_file, one_line_errors
from fetch_hand_sim.episode_log.untrusted import MESSAGE, RECORD, require_size, unpack

# Opcode, length and, of a message, its channel.
_MESSAGE = struct.Struct('<BQH')
# Opcode and length; then channel, sequence, log time and publish time.
_PREFIX = RECORD.size
_HEADER = MESSAGE.size
_LOG_TIME = slice(_PREFIX + 6, _PREFIX + 14)


@dataclass(frozen=True, slots=True)
class MessageRows:
    """The messages of one topic.

    Attributes:
        log_times: (n,), nanoseconds.
        data: (n, size) CDR bytes.
    """

    log_times: NDArray[np.int64]
    data: NDArray[np.uint8]


@dataclass(slots=True)
class MessageFile:
    """The messages of a file, unpacked, and where each of them lies.

    Attributes:
        path: The MCAP file.
        metadata: Contents of the metadata records by name; of equal names the last counts.
        unpacked: All chunks, one after the other.
        offsets: Where the messages of a topic start in `unpacked`, by resolved name.
        sizes: Their lengths without opcode and length.
    """

    path: Path
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    unpacked: bytes = b''
    offsets: dict[str, list[int]] = field(default_factory=dict)
    sizes: dict[str, list[int]] = field(default_factory=dict)

    def count(self, topic: str) -> int:
        """Returns the number of messages of a topic."""
        return len(self.sizes.get(topic, ()))

    def rows(self, topic: str) -> MessageRows:
        """Returns the messages of a topic in the order of the file.

        Raises:
            EpisodeReadError: If there are none, or not all of one size.
        """
        sizes = set(self.sizes.get(topic, ()))
        if len(sizes) != 1:
            found = f'sizes {sorted(sizes)}' if sizes else 'no message'
            raise EpisodeReadError(f'{self.path}: {found} of {topic}; one size is needed')
        size = sizes.pop()
        buffer = np.frombuffer(self.unpacked, np.uint8)
        starts = np.array(self.offsets[topic])[:, None]
        records = buffer[starts + np.arange(_PREFIX + size)]
        times = np.ascontiguousarray(records[:, _LOG_TIME]).view('<i8')[:, 0]
        return MessageRows(times, records[:, _PREFIX + _HEADER :])


def read_messages(path: Path) -> MessageFile:
    """Unpacks a file and finds its messages; CRCs of chunks are checked.

    Args:
        path: The bag directory, or its MCAP file.

    Raises:
        EpisodeReadError: If there is no such file, or it is truncated or damaged.
    """
    file = MessageFile(mcap_file(path))
    with one_line_errors(file.path), file.path.open('rb') as stream:
        require_size(stream)
        with mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            _Scan(file).take(buffer)
    return file


class _Scan:
    def __init__(self, file: MessageFile) -> None:
        self._file = file
        self._chunks: list[bytes] = []
        self._size = 0
        self._messages = 0
        self._topics: dict[int, str] = {}
        self._offsets: dict[int, list[int]] = defaultdict(list)
        self._sizes: dict[int, list[int]] = defaultdict(list)

    def take(self, buffer: mmap.mmap) -> None:
        metadata = 0
        for opcode, content in _data_section(buffer):
            metadata += opcode == Opcode.METADATA
            if metadata > MAX_METADATA_RECORDS:
                raise ValueError(f'more than {MAX_METADATA_RECORDS} metadata records')
            if opcode == Opcode.CHUNK:
                self._take_chunk(Chunk.read(ReadDataStream(BytesIO(content))))
            elif opcode == Opcode.METADATA:
                record = Metadata.read(ReadDataStream(BytesIO(content)))
                self._file.metadata[record.name] = dict(record.metadata)
        self._file.unpacked = b''.join(self._chunks)
        for id, topic in self._topics.items():
            self._file.offsets[topic] = self._offsets[id]
            self._file.sizes[topic] = self._sizes[id]

    def _take_chunk(self, chunk: Chunk) -> None:
        if self._size + chunk.uncompressed_size > MAX_UNPACKED_BYTES:
            raise ValueError(f'more than {MAX_UNPACKED_BYTES} bytes of messages')
        data = unpack(chunk)
        self._find_messages(data)
        self._chunks.append(data)
        self._size += len(data)

    def _find_messages(self, data: bytes) -> None:
        position, end, base = 0, len(data), self._size
        offsets, sizes, read = self._offsets, self._sizes, _MESSAGE.unpack_from
        while position < end:
            opcode, size, channel = read(data, position)
            following = position + _PREFIX + size
            if following > end:
                raise ValueError('a record is longer than its chunk')
            if opcode == Opcode.MESSAGE:
                if size < _HEADER:
                    raise ValueError('a message is shorter than its header')
                offsets[channel].append(base + position)
                sizes[channel].append(size)
                self._messages += 1
                if self._messages > MAX_MESSAGES:
                    raise ValueError(f'more than {MAX_MESSAGES} messages')
            elif opcode == Opcode.CHANNEL:
                content = BytesIO(data[position + _PREFIX : following])
                record = Channel.read(ReadDataStream(content))
                self._topics[record.id] = record.topic
            position = following


def _data_section(buffer: mmap.mmap) -> Iterator[tuple[int, bytes]]:
    """Yields opcode and content of chunks and metadata records; others are passed over."""
    magic = len(MCAP0_MAGIC)
    if buffer[:magic] != MCAP0_MAGIC or buffer[-magic:] != MCAP0_MAGIC:
        raise ValueError('it does not begin and end as an MCAP file')
    position, end = magic, len(buffer) - magic
    for _ in range(MAX_RECORDS):
        if position >= end:
            break
        opcode, size = RECORD.unpack_from(buffer, position)
        start, position = position + _PREFIX, position + _PREFIX + size
        if position > end:
            raise ValueError('a record is longer than the file')
        if opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.METADATA and size > MAX_RECORD_BYTES:
            raise ValueError(f'record of {size} bytes; allowed: up to {MAX_RECORD_BYTES}')
        if opcode in (Opcode.CHUNK, Opcode.METADATA):
            yield opcode, buffer[start:position]
    raise ValueError('no end of data')
