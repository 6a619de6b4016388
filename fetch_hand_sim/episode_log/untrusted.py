"""Records of a file that anybody may have made: no damage costs more memory than a limit.

The mcap package believes the lengths a file gives and asks the system for that much memory. Here a
length is compared with what is left of the file first, and a file is read no further than `limits`
say.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from io import BytesIO
from typing import BinaryIO, Protocol

import lz4.frame
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import EndOfFile
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, McapRecord, Message, Schema
from mcap.stream_reader import StreamReader

from fetch_hand_sim.episode_log.limits import (
    MAX_CHUNK_BYTES,
    MAX_FILE_BYTES,
    MAX_MESSAGES,
    MAX_METADATA_RECORDS,
    MAX_RECORD_BYTES,
    MAX_RECORDS,
    MAX_TOPICS,
    MAX_UNPACKED_BYTES,
)
from msgs_spec.schemas import MAX_MESSAGE_BYTES

# Opcode and length of a record; channel, sequence, log time and publish time of a message.
RECORD = struct.Struct('<BQ')
MESSAGE = struct.Struct('<HIQQ')


@dataclass(frozen=True, slots=True)
class ReadLimits:
    """How far a file is read.

    Attributes:
        chunk_bytes: Of a chunk, unpacked.
        unpacked_bytes: Of all chunks together.
        longest_message: Longer ones are passed over; None for none.
    """

    chunk_bytes: int = MAX_CHUNK_BYTES
    unpacked_bytes: int = MAX_UNPACKED_BYTES
    longest_message: int | None = None


EPISODE_LIMITS = ReadLimits()
# Version 0.1 logged whatever the robot received, in chunks that no reader took. Recovery leaves out
# what was too long and keeps the rest.
RECOVERY_LIMITS = ReadLimits(128 * 2**20, 512 * 2**20, MAX_MESSAGE_BYTES)


_DATA = frozenset(
    {
        Opcode.HEADER,
        Opcode.METADATA,
        Opcode.ATTACHMENT,
        Opcode.CHUNK,
        Opcode.DATA_END,
        Opcode.FOOTER,
    }
)
_LONG = frozenset({Opcode.ATTACHMENT, Opcode.CHUNK})


class _Readable(Protocol):
    def read(self, size: int = -1, /) -> bytes: ...


class BoundedStream:
    """A file that refuses to read more than it has left, before any memory is asked for.

    Args:
        stream: The file, read from where it stands.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = require_size(stream) - stream.tell()

    def read(self, size: int = -1, /) -> bytes:
        """Returns exactly `size` bytes.

        Raises:
            EndOfFile: If there are fewer.
        """
        if not 0 <= size <= self._left:
            raise EndOfFile()
        data = self._stream.read(size)
        self._left -= size
        return data


def require_size(stream: BinaryIO) -> int:
    """Returns the size of a file.

    Raises:
        ValueError: If it is larger than an episode may be.
    """
    size = os.fstat(stream.fileno()).st_size
    if size > MAX_FILE_BYTES:
        raise ValueError(f'{size} bytes; allowed: up to {MAX_FILE_BYTES}')
    return size


def unpack(chunk: Chunk, limit: int = MAX_CHUNK_BYTES) -> bytes:
    """Returns what a chunk holds, after a check of its CRC.

    Raises:
        ValueError: If it is larger than it says or than the limit, packed in an unknown way, or
            damaged.
        RuntimeError, zstandard.ZstdError: If it is damaged.
    """
    size = chunk.uncompressed_size
    if size > limit:
        raise ValueError(f'chunk of {size} bytes; allowed: up to {limit}')
    data = _decompress(chunk, size)
    if len(data) != size:
        raise ValueError(f'chunk holds {len(data)} bytes and says {size}')
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError('crc validation failed in Chunk')
    return data


def _decompress(chunk: Chunk, size: int) -> bytes:
    if chunk.compression == 'zstd':
        # The frame names a size of its own, which the library would allocate.
        if zstandard.frame_content_size(chunk.data) not in (-1, size):
            raise ValueError('chunk names two sizes')
        return zstandard.ZstdDecompressor().decompress(chunk.data, max_output_size=size)
    if chunk.compression == 'lz4':
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1))
    if chunk.compression == '':
        return chunk.data
    raise ValueError(f'chunk compression {chunk.compression!r}; allowed: zstd, lz4, none')


class Records(StreamReader):
    """Yields the wanted records of a stream and passes over the others, which may be long.

    Args:
        stream: Where to read from.
        wanted: Opcodes of the records to read.
        has_magic: Whether the stream begins as a file does; then the CRC of its data is checked.
    """

    def __init__(
        self, stream: _Readable, wanted: frozenset[Opcode], *, has_magic: bool = False
    ) -> None:
        super().__init__(
            stream,  # type: ignore[arg-type]
            skip_magic=not has_magic,
            emit_chunks=True,
            validate_crcs=has_magic,
        )
        self._wanted = wanted
        self._records_left = MAX_RECORDS
        self._metadata_left = MAX_METADATA_RECORDS

    def _read_record(self, opcode: int, length: int) -> McapRecord | None:
        self._records_left -= 1
        if self._records_left < 0:
            raise ValueError(f'more than {MAX_RECORDS} records')
        if opcode not in self._wanted:
            self._stream.read(length)
            return None
        if opcode == Opcode.METADATA:
            self._metadata_left -= 1
            if self._metadata_left < 0:
                raise ValueError(f'more than {MAX_METADATA_RECORDS} metadata records')
        if opcode not in _LONG and length > MAX_RECORD_BYTES:
            raise ValueError(f'record of {length} bytes; allowed: up to {MAX_RECORD_BYTES}')
        return super()._read_record(opcode, length)


def read_records(stream: BinaryIO, limits: ReadLimits = EPISODE_LIMITS) -> Iterator[McapRecord]:
    """Yields the records of a file and of its chunks, without indexes; all CRCs are checked.

    The contents of a chunk come after it, and the chunk itself comes empty.

    Raises:
        Exception: One of `reader.DAMAGED` where the file is damaged or beyond the limits; what came
            before is good.
    """
    reader = Records(BoundedStream(stream), _DATA, has_magic=True)
    contents = _ChunkContents(limits.longest_message)
    unpacked = 0
    for record in reader.records:
        if isinstance(record, Chunk):
            unpacked += record.uncompressed_size
            if unpacked > limits.unpacked_bytes:
                raise ValueError(f'more than {limits.unpacked_bytes} bytes of messages')
            data = unpack(record, limits.chunk_bytes)
            yield replace(record, compression='', data=b'')
            yield from contents.of(data)
        else:
            yield record


class _ChunkContents:
    """The records of unpacked chunks, as many as a file may hold."""

    def __init__(self, longest_message: int | None) -> None:
        self._longest = longest_message
        self._messages = 0
        self._others = 0

    def of(self, data: bytes) -> Iterator[McapRecord]:
        position, end = 0, len(data)
        while position < end:
            opcode, length = RECORD.unpack_from(data, position)
            start = position + RECORD.size
            position = start + length
            if position > end:
                raise ValueError('a record is longer than its chunk')
            if opcode == Opcode.MESSAGE:
                if self._longest is None or length <= self._longest:
                    yield self._message(data, start, position)
            else:
                yield from self._other(opcode, data[start:position])

    def _message(self, data: bytes, start: int, end: int) -> Message:
        self._messages += 1
        if self._messages > MAX_MESSAGES:
            raise ValueError(f'more than {MAX_MESSAGES} messages')
        if end - start < MESSAGE.size:
            raise ValueError('a message is shorter than its header')
        channel, sequence, log_time, publish_time = MESSAGE.unpack_from(data, start)
        content = data[start + MESSAGE.size : end]
        return Message(channel, log_time, content, publish_time, sequence)

    def _other(self, opcode: int, content: bytes) -> Iterator[McapRecord]:
        """Schemas and channels, once for each topic."""
        self._others += 1
        if self._others > 2 * MAX_TOPICS:
            raise ValueError(f'more than {2 * MAX_TOPICS} schemas and channels in chunks')
        if len(content) > MAX_RECORD_BYTES:
            raise ValueError(f'record of {len(content)} bytes; allowed: up to {MAX_RECORD_BYTES}')
        if opcode == Opcode.CHANNEL:
            yield Channel.read(ReadDataStream(BytesIO(content)))
        elif opcode == Opcode.SCHEMA:
            yield Schema.read(ReadDataStream(BytesIO(content)))
