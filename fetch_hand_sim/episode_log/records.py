"""Parse the data section of MCAP files with limited memory and CPU time.

`Contents` parses one record at a time, so recovery can keep all records before a damaged one. For
whole files, `indexes.parse_file` also checks the summary.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from msgs_spec.text import one_line

# Limits that writers and readers share: no writer makes a file that readers reject. The largest
# episode that this project writes has 1,400 messages, 0.4 MB. Received messages come from other
# processes, so they have an allowance, and a flood on one topic takes no room from the others.

# Messages of a file, and the topics they belong to.
MAX_MESSAGES = 50_000
MAX_TOPICS = 64
# All chunks of a file, unpacked.
MAX_UNPACKED_BYTES = 16 * 2**20
# Chunks of a file; each has an entry of some 250 bytes in the summary.
MAX_CHUNKS = 10_000
MAX_SUMMARY_BYTES = 4 * 2**20
# Records outside of chunks: an index of each of its topics follows each chunk.
MAX_RECORDS = 300_000
# A metadata record, and the metadata that a writer accepts; YAML may need ten times their size.
MAX_RECORD_BYTES = 2**20
MAX_METADATA_BYTES = 2**16
# Entries of a metadata record, or of the metadata of a channel.
MAX_MAP_ENTRIES = 1000
# Metadata records of a file; a robot writes two, and two for rosbag2.
MAX_METADATA_RECORDS = 16
# All attachments of a file, and the file; a compiled model has 3 MB.
MAX_ATTACHMENTS = 100
MAX_ATTACHMENT_BYTES = 64 * 2**20
MAX_FILE_BYTES = 128 * 2**20

# Received messages on one topic that an episode contains; the robot subscribes to four.
MAX_RECEIVED_MESSAGES = MAX_MESSAGES // 10
MAX_RECEIVED_BYTES = MAX_UNPACKED_BYTES // 8

# Opcode and length of a record.
RECORD = struct.Struct('<BQ')
MESSAGE = np.dtype(
    [
        ('opcode', 'u1'),
        ('size', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('log_time', '<u8'),
        ('publish_time', '<u8'),
    ]
)
# Plain numbers are faster to compare than members of an enumeration.
_MESSAGE, _MESSAGE_INDEX = int(Opcode.MESSAGE), int(Opcode.MESSAGE_INDEX)
_DEFINITIONS = frozenset({Opcode.SCHEMA, Opcode.CHANNEL})
_KNOWN = frozenset(Opcode)
# Times of a chunk, its unpacked size and CRC; channel and size of a message index.
_CHUNK_HEADER = struct.Struct('<QQQI')
_INDEX_HEADER = struct.Struct('<HI')
_INDEX_ENTRY_BYTES = 16
# Position and length of an indexed record.
_PLACE = struct.Struct('<QQ')
MESSAGE_FIELD_BYTES = MESSAGE.itemsize - RECORD.size
_LATEST_NS = 2**63 - 1


class Fields:
    """Reads the little-endian fields of one record, one after the other.

    Methods raise `ValueError` if the record is too short, or if text is not UTF-8.
    """

    def __init__(self, data: bytes, kind: str) -> None:
        self._data = data
        self._position = 0
        self._kind = kind

    @property
    def is_at_end(self) -> bool:
        """True if all fields are read."""
        return self._position == len(self._data)

    def end(self) -> None:
        """Raise ValueError for bytes after the last field, which some programs would parse."""
        if not self.is_at_end:
            raise ValueError(f'ambiguous: a {self._kind} record is longer than its fields')

    def number(self, size: int) -> int:
        """Read an unsigned number of `size` bytes."""
        return int.from_bytes(self.bytes(size), 'little')

    def numbers(self, layout: struct.Struct) -> tuple[int, ...]:
        """Read several numbers of the binary format `layout`."""
        return layout.unpack(self.bytes(layout.size))

    def bytes(self, size: int) -> bytes:
        """Read `size` bytes."""
        start, self._position = self._position, self._position + size
        if self._position > len(self._data):
            raise ValueError(f'damaged: a {self._kind} record is shorter than its fields')
        return self._data[start : self._position]

    def text(self) -> str:
        """Read a text, stored as its length and UTF-8 bytes."""
        return self.bytes(self.number(4)).decode()

    def strings(self) -> dict[str, str]:
        """Read a map of text to text; ValueError for a repeated key or over `MAX_MAP_ENTRIES`."""
        fields = Fields(self.bytes(self.number(4)), self._kind)
        found: dict[str, str] = {}
        while not fields.is_at_end:
            key, value = fields.text(), fields.text()
            if key in found:
                raise ValueError(f'a {self._kind} record has the key {shown(key)} twice')
            if len(found) == MAX_MAP_ENTRIES:
                raise ValueError(f'a {self._kind} record with more than {MAX_MAP_ENTRIES} entries')
            found[key] = value
        return found


def shown(text: str) -> str:
    """Quote a text from a file for an error message, shortened to one line."""
    return f"'{one_line(text, longest=60)}'"


@dataclass(frozen=True, slots=True)
class Schema:
    """A schema record of MCAP: name and definition of a message type."""

    name: str
    encoding: str
    text: bytes


@dataclass(frozen=True, slots=True)
class Channel:
    """A channel record of MCAP: a topic and its encoding."""

    schema_id: int
    topic: str
    encoding: str
    metadata: dict[str, str]


@dataclass(frozen=True, slots=True)
class Chunk:
    """Position and header of a chunk in the file.

    Attributes:
        position: Byte offset of the chunk record in the file.
        length: Bytes of the chunk record.
        times: First and last log time of its messages, ns, as the chunk records them.
        base: Byte offset of its unpacked records in `Messages.unpacked`.
    """

    position: int
    length: int
    times: tuple[int, int]
    compression: str
    packed_bytes: int
    unpacked_bytes: int
    base: int


class MessageIndex(NamedTuple):
    """A message index record of MCAP: log time and offset of the messages of a channel in a chunk.

    `chunk` is an index of `Contents.chunks`, `position` the byte offset of the record in the file.
    """

    chunk: int
    position: int
    channel: int
    entries: bytes


@dataclass(frozen=True, slots=True)
class MetadataRecord:
    """A metadata record; `index` has the bytes that its index record in the summary must have."""

    index: bytes
    name: str
    content: dict[str, str]


@dataclass(frozen=True, slots=True)
class AttachmentRecord:
    """An attachment; `index` is the content that its index record in the summary must have."""

    index: bytes
    name: str
    media_type: str
    data: bytes


class Contents:
    """All records of the data section of a file, inside and outside of chunks.

    `take` raises `ValueError` and skips the record in three cases: it is damaged, it exceeds a
    limit, or it defines an existing id with different contents. Schemas and channels are stored by
    id, other records in order.
    """

    def __init__(self) -> None:
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: list[MetadataRecord] = []
        self.attachments: list[AttachmentRecord] = []
        self.chunks: list[Chunk] = []
        self.message_indexes: list[MessageIndex] = []
        self.messages_outside = 0
        self._definitions: dict[tuple[int, int], bytes] = {}
        self._runs: list[bytes] = []
        self._size = 0
        self._starts: list[int] = []
        # Where the definition of each channel is in the unpacked data.
        self._channel_starts: dict[int, int] = {}

    def take(self, opcode: int, data: bytes, position: int, end: int) -> None:
        """Parse the record `data[position:end]`; store it if it belongs to the data section."""
        start = position + RECORD.size
        if opcode == _MESSAGE_INDEX:
            self._take_message_index(data[start:end], position)
        elif opcode == Opcode.CHUNK:
            self._take_chunk(data[start:end], position, end - position)
        elif opcode in (Opcode.MESSAGE, Opcode.SCHEMA, Opcode.CHANNEL):
            self._require_room(end - position)
            self._take_run(data[position:end])
            self.messages_outside += opcode == Opcode.MESSAGE
        elif opcode == Opcode.HEADER:
            fields = Fields(data[start:end], 'header')
            _ = fields.text(), fields.text()
            fields.end()
        elif opcode == Opcode.METADATA:
            self._take_metadata(data[start:end], position, end - position)
        elif opcode == Opcode.ATTACHMENT:
            self._take_attachment(data[start:end], position, end - position)

    def define(self, opcode: int, content: bytes, offset: int = 0) -> None:
        """Parse and store a schema or channel from byte `offset` of the unpacked chunk."""
        id = int.from_bytes(content[:2], 'little')
        known = self._definitions.get((opcode, id))
        if known == content:
            return
        kind = 'schema' if opcode == Opcode.SCHEMA else 'channel'
        if len(content) > MAX_RECORD_BYTES:
            raise ValueError(f'record of {len(content)} bytes; allowed: up to {MAX_RECORD_BYTES}')
        if known is not None:
            raise ValueError(f'ambiguous: {kind} {id} is defined twice, with different contents')
        if len(self._definitions) == 2 * MAX_TOPICS:
            raise ValueError(f'more than {2 * MAX_TOPICS} schemas and channels')
        self._definitions[opcode, id] = content
        fields = Fields(content, kind)
        fields.number(2)
        if opcode == Opcode.SCHEMA:
            name, encoding = fields.text(), fields.text()
            schema = Schema(name, encoding, fields.bytes(fields.number(4)))
            fields.end()
            self.schemas[id] = schema
        else:
            schema_id, topic, encoding = fields.number(2), fields.text(), fields.text()
            channel = Channel(schema_id, topic, encoding, fields.strings())
            fields.end()
            if schema_id and schema_id not in self.schemas:
                raise ValueError(f'damaged: channel {id} comes before its schema {schema_id}')
            self.channels[id] = channel
            self._channel_starts[id] = self._size + offset

    @property
    def message_count(self) -> int:
        """Number of messages stored so far."""
        return len(self._starts)

    def messages(self) -> Messages:
        """Return all messages, sorted by log time.

        Equal log times, times beyond int64, and messages before their channel raise ValueError.
        """
        unpacked = b''.join(self._runs)
        starts = np.array(self._starts, dtype=np.int64)
        buffer = np.frombuffer(unpacked, np.uint8)
        bytes_of_headers = buffer[starts[:, None] + np.arange(MESSAGE.itemsize)]
        headers = np.ascontiguousarray(bytes_of_headers).view(MESSAGE)[:, 0]
        times = headers['log_time']
        if times.size and max(times.max(), headers['publish_time'].max()) > _LATEST_NS:
            raise ValueError(f'a message with a time beyond {_LATEST_NS} ns')
        undefined = set(np.unique(headers['channel']).tolist()) - self.channels.keys()
        if undefined:
            raise ValueError(f'messages of channel {min(undefined)}, which is not defined')
        for id, first in zip(*np.unique(headers['channel'], return_index=True), strict=True):
            if starts[first] < self._channel_starts[int(id)]:
                raise ValueError(f'damaged: a message of channel {id} comes before the channel')
        if (times[1:] > times[:-1]).all():
            return Messages(unpacked, starts, headers)
        order = np.argsort(times, kind='stable')
        sorted_times = times[order]
        (equal,) = np.nonzero(sorted_times[1:] == sorted_times[:-1])
        if equal.size:
            raise ValueError(
                f'ambiguous: two messages have the log time {sorted_times[equal[0]]} ns; '
                'are there several episodes in the file?'
            )
        return Messages(unpacked, starts[order], headers[order])

    def _require_room(self, size: int) -> None:
        if self._size + size > MAX_UNPACKED_BYTES:
            raise ValueError(f'more than {MAX_UNPACKED_BYTES} bytes of messages')

    def _take_chunk(self, content: bytes, position: int, length: int) -> None:
        if len(self.chunks) == MAX_CHUNKS:
            raise ValueError(f'more than {MAX_CHUNKS} chunks')
        fields = Fields(content, 'chunk')
        first, last, size, crc = fields.numbers(_CHUNK_HEADER)
        compression = fields.text()
        packed = fields.bytes(fields.number(8))
        fields.end()
        self._require_room(size)
        data = _unpack(packed, compression, size)
        if crc not in (0, zlib.crc32(data)):
            raise ValueError('damaged: the CRC of a chunk is wrong')
        base = self._size
        self._take_run(data)
        self.chunks.append(
            Chunk(position, length, (first, last), compression, len(packed), size, base)
        )

    def _take_run(self, data: bytes) -> None:
        """Parse and store the schemas, channels and messages in `data`, consecutive records."""
        starts: list[int] = []
        position, end, base = 0, len(data), self._size
        read = RECORD.unpack_from
        while position < end:
            opcode, size = read(data, position) if end - position >= RECORD.size else (0, end)
            following = position + RECORD.size + size
            if following > end:
                raise ValueError('damaged: a record is longer than its chunk')
            if opcode == _MESSAGE:
                if size < MESSAGE_FIELD_BYTES:
                    raise ValueError('damaged: a message is shorter than its header')
                starts.append(base + position)
            elif opcode in _DEFINITIONS:
                self.define(opcode, data[position + RECORD.size : following], position)
            elif opcode in _KNOWN:
                raise ValueError(f'damaged: a record of kind {opcode} in a chunk')
            position = following
        if len(self._starts) + len(starts) > MAX_MESSAGES:
            raise ValueError(f'more than {MAX_MESSAGES} messages')
        self._starts += starts
        self._runs.append(data)
        self._size += len(data)

    def _take_message_index(self, content: bytes, position: int) -> None:
        size = len(content) - _INDEX_HEADER.size
        channel, expected = _INDEX_HEADER.unpack_from(content) if size >= 0 else (0, -1)
        if size != expected or size % _INDEX_ENTRY_BYTES or not self.chunks:
            raise ValueError('damaged: a message index of another size, or without a chunk')
        entries = content[_INDEX_HEADER.size :]
        self.message_indexes.append(MessageIndex(len(self.chunks) - 1, position, channel, entries))

    def _take_metadata(self, content: bytes, position: int, length: int) -> None:
        if length > MAX_RECORD_BYTES:
            raise ValueError(f'record of {length} bytes; allowed: up to {MAX_RECORD_BYTES}')
        if len(self.metadata) == MAX_METADATA_RECORDS:
            raise ValueError(f'more than {MAX_METADATA_RECORDS} metadata records')
        fields = Fields(content, 'metadata')
        name, strings = fields.text(), fields.strings()
        fields.end()
        index = _PLACE.pack(position, length) + _text(name)
        self.metadata.append(MetadataRecord(index, name, strings))

    def _take_attachment(self, content: bytes, position: int, length: int) -> None:
        if len(self.attachments) == MAX_ATTACHMENTS:
            raise ValueError(f'more than {MAX_ATTACHMENTS} attachments')
        fields = Fields(content, 'attachment')
        times, name, media_type = fields.bytes(16), fields.text(), fields.text()
        data = fields.bytes(fields.number(8))
        if fields.number(4) not in (0, zlib.crc32(memoryview(content)[:-4])):
            raise ValueError(f'damaged: the CRC of the attachment {shown(name)} is wrong')
        fields.end()
        if sum(len(each.data) for each in self.attachments) + len(data) > MAX_ATTACHMENT_BYTES:
            raise ValueError(f'more than {MAX_ATTACHMENT_BYTES} bytes attached')
        place, size = _PLACE.pack(position, length), len(data).to_bytes(8, 'little')
        index = place + times + size + _text(name) + _text(media_type)
        self.attachments.append(AttachmentRecord(index, name, media_type, data))


def _text(text: str) -> bytes:
    """Encode a text for MCAP: its length in bytes (4 bytes), then UTF-8."""
    return len(text.encode()).to_bytes(4, 'little') + text.encode()


@dataclass(frozen=True, slots=True)
class Messages:
    """The messages of a file, sorted by log time.

    Attributes:
        unpacked: All unpacked chunks and all records outside of chunks, one after the other.
        starts: (n,) byte offset of each message record in `unpacked`.
        headers: (n,) headers of the messages, of the structured type `MESSAGE`.
    """

    unpacked: bytes
    starts: NDArray[np.int64]
    headers: NDArray[np.void]

    def rows(self) -> Iterator[tuple[int, int, int, int, bytes]]:
        """Yield channel id, sequence, log and publish time (ns) and data of each message."""
        for start, header in zip(self.starts.tolist(), self.headers.tolist(), strict=True):
            _, size, channel, sequence, log_time, publish_time = header
            data = self.unpacked[start + MESSAGE.itemsize : start + RECORD.size + size]
            yield channel, sequence, log_time, publish_time, data


def split_records(data: bytes) -> Iterator[tuple[int, int, int]]:
    """Yield opcode, start and end of each record of a file, beginning with the header record.

    `data[start:end]` is the whole record. A missing header, a cut-off record and more than
    `MAX_RECORDS` records raise ValueError. So do the magic bytes after the footer: the caller
    removes them or stops at the footer.
    """
    magic = len(MCAP0_MAGIC)
    if data[:magic] != MCAP0_MAGIC:
        raise ValueError('no MCAP file: its first bytes are not those of one')
    position, size = magic, len(data)
    for _ in range(MAX_RECORDS):
        if position == size:
            return
        is_torn = size - position < RECORD.size
        opcode, length = (0, size) if is_torn else RECORD.unpack_from(data, position)
        end = position + RECORD.size + length
        if end > size:
            raise ValueError('truncated or damaged: a record is longer than the rest of the file')
        if position == magic and opcode != Opcode.HEADER:
            raise ValueError('damaged: the first record is no header')
        yield opcode, position, end
        position = end
    raise ValueError(f'more than {MAX_RECORDS} records')


def _unpack(packed: bytes, compression: str, size: int) -> bytes:
    """Decompress a chunk (`zstd`, `lz4` or ''); ValueError unless the result has `size` bytes."""
    try:
        data = _decompress(packed, compression, size)
    except (zstandard.ZstdError, RuntimeError, EOFError) as error:
        raise ValueError(f'damaged: a chunk cannot be unpacked ({one_line(error)})') from None
    if len(data) != size:
        raise ValueError(f'damaged: a chunk of {len(data)} bytes records {size}')
    return data


def _decompress(packed: bytes, compression: str, size: int) -> bytes:
    if compression == '':
        return packed
    if compression == 'zstd':
        # The frame names a size of its own, which the library would allocate.
        if zstandard.frame_content_size(packed) not in (-1, size):
            raise ValueError('damaged: a chunk records two sizes')
        unpacker = zstandard.ZstdDecompressor()
        return unpacker.decompress(packed, max_output_size=size, allow_extra_data=False)
    if compression == 'lz4':
        frame = lz4.frame.LZ4FrameDecompressor()
        data = bytes(frame.decompress(packed, max_length=size + 1))
        if not frame.eof or frame.unused_data:
            raise ValueError('damaged: a chunk is not one frame of lz4')
        return data
    raise ValueError(f'chunk compression {shown(compression)}; allowed: zstd, lz4, none')
