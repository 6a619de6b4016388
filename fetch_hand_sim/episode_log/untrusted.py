"""Records of a file that anybody may have made: no damage costs more memory than a limit.

The mcap package believes the lengths a file gives and asks the system for that much memory. Here a
length is compared with what is left of the file first, and a chunk is unpacked no further than
`limits` allow.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO, Protocol

import lz4.frame
import zstandard
from mcap.exceptions import EndOfFile
from mcap.records import Chunk, McapRecord
from mcap.stream_reader import StreamReader, breakup_chunk

from fetch_hand_sim.episode_log.limits import MAX_CHUNK_BYTES, MAX_UNPACKED_BYTES


class _Readable(Protocol):
    def read(self, size: int = -1, /) -> bytes: ...


class BoundedStream:
    """A file that refuses to read more than it has left, before any memory is asked for.

    Args:
        stream: The file, read from where it stands.
    """

    def __init__(self, stream: BinaryIO) -> None:
        self._stream = stream
        self._left = os.fstat(stream.fileno()).st_size - stream.tell()

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


def unpack(chunk: Chunk) -> bytes:
    """Returns what a chunk holds; its CRC is not checked.

    Raises:
        ValueError: If it is larger than it says or than the limit, or packed in an unknown way.
        RuntimeError, zstandard.ZstdError: If it is damaged.
    """
    size = chunk.uncompressed_size
    if size > MAX_CHUNK_BYTES:
        raise ValueError(f'chunk of {size} bytes; allowed: up to {MAX_CHUNK_BYTES}')
    data = _decompress(chunk, size)
    if len(data) != size:
        raise ValueError(f'chunk holds {len(data)} bytes and says {size}')
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


def read_chunks(stream: BinaryIO) -> Iterator[McapRecord]:
    """Yields the records of a file; CRCs of the data section are checked, those of chunks not.

    Chunks come unpacked, as chunks without compression.

    Raises:
        Exception: One of `reader.DAMAGED` where the file is damaged; what came before is good.
    """
    unpacked = 0
    bounded: _Readable = BoundedStream(stream)
    reader = StreamReader(
        bounded,  # type: ignore[arg-type]
        emit_chunks=True,
        validate_crcs=True,
    )
    for record in reader.records:
        if isinstance(record, Chunk):
            unpacked += record.uncompressed_size
            if unpacked > MAX_UNPACKED_BYTES:
                raise ValueError(f'more than {MAX_UNPACKED_BYTES} bytes of messages')
            yield replace(record, compression='', data=unpack(record))
        else:
            yield record


def read_records(stream: BinaryIO) -> Iterator[McapRecord]:
    """Yields the records of a file and of its chunks, all CRCs of data checked; see `read_chunks`.

    Messages come a whole chunk at a time, after the check of its CRC.
    """
    for record in read_chunks(stream):
        if isinstance(record, Chunk):
            yield from breakup_chunk(record, validate_crc=True)
        else:
            yield record
