"""Damages episode files in every way a seed can think of and gives them to everything that reads.

    python test/support/mutated_files.py EPISODE COUNT SEED

Runs with a limit on memory. Prints a JSON object that counts outcomes by reader, and ends with 1 at
the first one that is neither a result nor a one-line error. Every file is read within a second of
processor time, or a signal ends the process.
"""

from __future__ import annotations

import itertools
import json
import resource
import shutil
import signal
import struct
import sys
import tempfile
import time
import zlib
from collections import Counter
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path

import lz4.frame
import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from fetch_hand_sim.commands import episodes_list
from fetch_hand_sim.episode_log import (
    EpisodeLogError,
    EpisodeReadError,
    EpisodeSummary,
    load_episodes,
    read_episode,
    read_summary,
    recover_episode,
)
from fetch_hand_sim.episode_log.arrays import EpisodeArrays
from fetch_hand_sim.replay_node.schedule import ReplaySchedule
from support import peak_memory

# Beyond what the interpreter with all libraries has mapped when the first file is read.
MEMORY_BYTES = 768 * 2**20
CPU_SECONDS = 10
MAGIC = bytes([137, 77, 67, 65, 80, 48, 13, 10])
LENGTHS = (0, 1, 2**16, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)


class Mutator:
    """Makes damaged files of a whole one.

    Args:
        whole: The file.
        seed: Of the damage.
    """

    def __init__(self, whole: bytes, seed: int) -> None:
        self.whole = whole
        self.random = np.random.default_rng(seed)
        self.records = _record_offsets(whole)
        self.kinds = (
            self.flip_bits,
            self.truncate,
            self.oversize_a_record,
            self.oversize_inside,
            self.drop_a_record,
            self.swap_records,
            self.foreign_bytes,
            self.damage_in_a_valid_chunk,
            self.bomb,
        )

    def make(self, number: int) -> tuple[str, bytes]:
        kind = self.kinds[number % len(self.kinds)]
        return kind.__name__, kind()

    def _position(self) -> int:
        return int(self.random.integers(len(self.whole)))

    def flip_bits(self) -> bytes:
        data = bytearray(self.whole)
        for _ in range(int(self.random.integers(1, 9))):
            data[self._position()] ^= 1 << int(self.random.integers(8))
        return bytes(data)

    def truncate(self) -> bytes:
        return self.whole[: self._position()]

    def oversize_a_record(self) -> bytes:
        data = bytearray(self.whole)
        offset = int(self.random.choice(self.records))
        struct.pack_into('<Q', data, offset + 1, LENGTHS[int(self.random.integers(len(LENGTHS)))])
        return bytes(data)

    def oversize_inside(self) -> bytes:
        """A length of four or eight bytes near the start of a record, such as that of a string."""
        data = bytearray(self.whole)
        offset = int(self.random.choice(self.records)) + 9 + int(self.random.integers(48))
        value = LENGTHS[int(self.random.integers(len(LENGTHS)))]
        if self.random.random() < 0.5:
            struct.pack_into('<I', data, min(offset, len(data) - 4), value & 0xFFFFFFFF)
        else:
            struct.pack_into('<Q', data, min(offset, len(data) - 8), value)
        return bytes(data)

    def drop_a_record(self) -> bytes:
        index = int(self.random.integers(len(self.records) - 1))
        return self.whole[: self.records[index]] + self.whole[self.records[index + 1] :]

    def swap_records(self) -> bytes:
        edges = [*self.records, len(self.whole) - len(MAGIC)]
        parts = [self.whole[a:b] for a, b in itertools.pairwise(edges)]
        first, second = self.random.integers(len(parts), size=2)
        parts[first], parts[second] = parts[second], parts[first]
        return MAGIC + b''.join(parts) + MAGIC

    def foreign_bytes(self) -> bytes:
        body = self.random.bytes(int(self.random.integers(4096)))
        return MAGIC + body + MAGIC if self.random.random() < 0.5 else body

    def damage_in_a_valid_chunk(self) -> bytes:
        """Flipped bits under a valid CRC."""
        data = bytearray()
        position = 0
        for offset, chunk in _chunks(self.whole, self.records):
            content = bytearray(lz4.frame.decompress(chunk.data))
            for _ in range(int(self.random.integers(3))):
                content[int(self.random.integers(len(content)))] ^= 1 << int(
                    self.random.integers(8)
                )
            end = offset + 9 + struct.unpack_from('<Q', self.whole, offset + 1)[0]
            packed = lz4.frame.compress(bytes(content))
            sizes = {'uncompressed_crc': zlib.crc32(content), 'uncompressed_size': len(content)}
            changed = replace(chunk, compression='lz4', data=packed, **sizes)
            data += self.whole[position:offset] + _chunk_record(changed)
            position = end
        return bytes(data + self.whole[position:])

    def bomb(self) -> bytes:
        """A small chunk of large uncompressed size, with a right or wrong size field."""
        size = int(2 ** self.random.integers(20, 27))
        told = int(self.random.choice([size, 2**12, 2**40]))
        # One record of a kind that readers skip.
        zeros = b'\x80' + struct.pack('<Q', size - 9) + bytes(size - 9)
        if self.random.random() < 0.5:
            packed, name = zstandard.ZstdCompressor(level=1).compress(zeros), 'zstd'
        else:
            packed, name = lz4.frame.compress(zeros), 'lz4'
        chunk = Chunk(name, packed, 0, 0, 0, told)
        record = _chunk_record(chunk) * int(self.random.integers(1, 200))
        offset = next(offset for offset, _ in _chunks(self.whole, self.records))
        return self.whole[:offset] + record + self.whole[offset:]


def _record_offsets(data: bytes) -> list[int]:
    offsets, position = [], len(MAGIC)
    while position < len(data) - len(MAGIC):
        offsets.append(position)
        position += 9 + struct.unpack_from('<Q', data, position + 1)[0]
    return offsets


def _chunks(data: bytes, offsets: list[int]) -> list[tuple[int, Chunk]]:
    found = [offset for offset in offsets if data[offset] == 6]
    with tempfile.TemporaryFile() as stream:
        stream.write(data)
        stream.seek(0)
        records = StreamReader(stream, emit_chunks=True).records
        chunks = [record for record in records if isinstance(record, Chunk)]
    return list(zip(found, chunks, strict=True))


def _chunk_record(chunk: Chunk) -> bytes:
    builder = RecordBuilder()
    chunk.write(builder)
    return builder.end()


def _list(path: Path) -> object:
    with redirect_stdout(StringIO()), redirect_stderr(StringIO()) as errors:
        code = episodes_list.main([str(path.parent)])
    if code:
        raise EpisodeReadError(errors.getvalue().strip())
    return read_summary(path)


def _recover(path: Path) -> object:
    leftover = path.parent / '.episode.active'
    leftover.mkdir()
    shutil.copy(path, leftover / 'episode_0.mcap')
    try:
        recovered = recover_episode(leftover)
        return recovered and read_episode(recovered)
    finally:
        shutil.rmtree(leftover, ignore_errors=True)
        shutil.rmtree(path.parent / 'episode', ignore_errors=True)


READERS = {
    'read_episode': read_episode,
    'read_summary': read_summary,
    'load_episodes': load_episodes,
    'episodes list': _list,
    'ReplaySchedule': ReplaySchedule,
    'recover_episode': _recover,
}


def outcome(read: object, path: Path) -> str:
    """Return the outcome of a reader; unexpected errors fail the run."""
    try:
        result = read(path)
    except (EpisodeReadError, EpisodeLogError) as error:
        text = str(error)
        assert '\n' not in text and len(text) < 600 and text.isprintable(), repr(text)
        return 'error'
    if result is None:
        return 'cleared away'
    if isinstance(result, list):
        assert all(isinstance(each, EpisodeArrays) for each in result)
        assert all(np.isfinite(each.observations['observation']).all() for each in result)
    elif isinstance(result, EpisodeSummary):
        assert result.message_count >= 0
    return 'read'


def main() -> int:
    source, count, seed = Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3])
    mutator = Mutator(source.read_bytes(), seed)
    counts: Counter[str] = Counter()
    slowest = 0.0
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / 'x.mcap'
        path.write_bytes(mutator.whole)
        for read in READERS.values():
            assert outcome(read, path) == 'read'
        mapped = int(Path('/proc/self/statm').read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (mapped + MEMORY_BYTES,) * 2)
        for number in range(count):
            kind, data = mutator.make(number)
            path.write_bytes(data)
            for name, read in READERS.items():
                signal.setitimer(signal.ITIMER_PROF, CPU_SECONDS)
                began = time.process_time()
                try:
                    counts[f'{name} {outcome(read, path)}'] += 1
                except BaseException:
                    print(f'file {number} ({kind}), {name}', file=sys.stderr)
                    Path(tempfile.gettempdir(), 'mutated_file.mcap').write_bytes(data)
                    raise
                slowest = max(slowest, time.process_time() - began)
                signal.setitimer(signal.ITIMER_PROF, 0)
    peak = peak_memory()
    print(json.dumps({'outcomes': counts, 'slowest_s': slowest, 'peak_bytes': peak}))
    return 0


if __name__ == '__main__':
    sys.exit(main())
