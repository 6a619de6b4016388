"""Parse whole MCAP files, and reject files whose indexes and contents disagree.

Some programs read an MCAP file from the beginning. Others start at the summary and follow its
indexes. A file is ambiguous if both ways lead to different contents; `parse_file` rejects it.
"""

from __future__ import annotations

import struct
import zlib
from collections import Counter, defaultdict

import numpy as np
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from fetch_hand_sim.episode_log.records import (
    MAX_SUMMARY_BYTES,
    RECORD,
    Contents,
    Fields,
    Messages,
    shown,
    split_records,
)

# CRC of the summary and magic, bytes.
_FILE_END = 4 + len(MCAP0_MAGIC)
_DATA_END, _FOOTER, _SUMMARY_OFFSET = map(struct.Struct, ('<I', '<QQI', '<BQQ'))
_INDEX_OFFSET = struct.Struct('<HQ')
_CHUNK_INDEX = struct.Struct('<QQQQI')
_CHUNK_SIZES = struct.Struct('<QQ')
_STATISTICS = struct.Struct('<QHIIIIQQI')
# Bytes of a message index beside its entries.
_INDEX_BYTES = RECORD.size + 2 + 4
_KNOWN = frozenset(Opcode)
_IN_SUMMARY = frozenset(
    {
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.CHUNK_INDEX,
        Opcode.ATTACHMENT_INDEX,
        Opcode.METADATA_INDEX,
        Opcode.STATISTICS,
        Opcode.SUMMARY_OFFSET,
        Opcode.FOOTER,
    }
)
_SUMMARY_ONLY = _IN_SUMMARY - {Opcode.SCHEMA, Opcode.CHANNEL}

Summary = dict[int, list[tuple[int, int]]]


def parse_file(data: bytes) -> tuple[Contents, Messages]:
    """Parse a whole MCAP file; ValueError if it is damaged, ambiguous, or exceeds the limits."""
    if not data.endswith(MCAP0_MAGIC):
        raise ValueError('truncated, damaged or no MCAP file: its last bytes are not those of one')
    contents = Contents()
    summary: Summary = defaultdict(list)
    summary_start = 0
    for opcode, position, end in split_records(data[: -len(MCAP0_MAGIC)]):
        if summary_start:
            if opcode in _KNOWN and opcode not in _IN_SUMMARY:
                raise ValueError(f'ambiguous: a {_kind(opcode)} record after the end of the data')
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                contents.define(opcode, data[position + RECORD.size : end])
            summary[opcode].append((position, end))
        elif opcode == Opcode.DATA_END:
            _check_data_crc(data, position, end)
            summary_start = end
        elif opcode in _SUMMARY_ONLY or (opcode == Opcode.HEADER and position > len(MCAP0_MAGIC)):
            raise ValueError(f'ambiguous: a {_kind(opcode)} record before the end of the data')
        else:
            contents.take(opcode, data, position, end)
    require_one_meaning(contents)
    messages = contents.messages()
    _check_footer(data, summary, summary_start)
    _check_offsets(data, summary)
    _check_record_indexes(data, summary, contents)
    _check_chunk_indexes(data, summary, contents, messages)
    _check_message_indexes(contents, messages)
    _check_statistics(data, summary, contents, messages)
    return contents, messages


def require_one_meaning(contents: Contents) -> None:
    """Raise ValueError if a file has two episodes, or two topics or attachments of one name."""
    for name, count in Counter(each.name for each in contents.metadata).items():
        if count > 1 and name.startswith('episode'):
            raise ValueError(
                f'{count} metadata records {shown(name)}: a file of {count} episodes, or a changed '
                'one; allowed: one episode'
            )
    for what, names in (
        ('channels of topic', [channel.topic for channel in contents.channels.values()]),
        ('attachments', [attachment.name for attachment in contents.attachments]),
    ):
        name, count = next(iter(Counter(names).most_common(1)), ('', 0))
        if count > 1:
            raise ValueError(f'ambiguous: {count} {what} {shown(name)}; allowed: one')


def _kind(opcode: int) -> str:
    return Opcode(opcode).name.lower().replace('_', ' ')


def _fields(data: bytes, position: int, end: int) -> Fields:
    return Fields(data[position + RECORD.size : end], _kind(data[position]))


def _numbers(data: bytes, position: int, end: int, layout: struct.Struct) -> tuple[int, ...]:
    """Return the numbers of the record `data[position:end]`; ValueError if its size is wrong."""
    fields = _fields(data, position, end)
    numbers = fields.numbers(layout)
    fields.end()
    return numbers


def _check_data_crc(data: bytes, position: int, end: int) -> None:
    (crc,) = _numbers(data, position, end, _DATA_END)
    if crc not in (0, zlib.crc32(memoryview(data)[:position])):
        raise ValueError('damaged: the CRC of the data is wrong')


def _check_footer(data: bytes, summary: Summary, summary_start: int) -> None:
    """Raise ValueError unless the file ends with one footer that fits the summary."""
    footers = summary[Opcode.FOOTER]
    if len(footers) != 1 or footers[0][1] != len(data) - len(MCAP0_MAGIC):
        raise ValueError('truncated or damaged: the file does not end with one footer')
    position, end = footers[0]
    start, offsets_start, crc = _numbers(data, position, end, _FOOTER)
    is_empty = position == summary_start
    if start != summary_start and not (is_empty and start == 0):
        raise ValueError('ambiguous: the footer does not point at the summary')
    if len(data) - summary_start > MAX_SUMMARY_BYTES:
        raise ValueError(f'summary of more than {MAX_SUMMARY_BYTES} bytes')
    if crc not in (0, zlib.crc32(memoryview(data)[summary_start:-_FILE_END])):
        raise ValueError('damaged: the CRC of the summary is wrong')
    groups = summary[Opcode.SUMMARY_OFFSET]
    if offsets_start not in (0, groups[0][0] if groups else position):
        raise ValueError('ambiguous: the footer does not point at the offsets of the summary')


def _check_offsets(data: bytes, summary: Summary) -> None:
    for position, end in summary[Opcode.SUMMARY_OFFSET]:
        opcode, start, length = _numbers(data, position, end, _SUMMARY_OFFSET)
        found = summary.get(opcode, [])
        expected = (found[0][0], sum(b - a for a, b in found)) if found else (start, 0)
        if (start, length) != expected:
            raise ValueError('ambiguous: an offset of the summary does not point at its group')


def _check_record_indexes(data: bytes, summary: Summary, contents: Contents) -> None:
    """Raise ValueError if an index of metadata or attachments exists and is wrong."""
    for what, opcode, expected in (
        ('metadata', Opcode.METADATA_INDEX, [each.index for each in contents.metadata]),
        ('attachments', Opcode.ATTACHMENT_INDEX, [each.index for each in contents.attachments]),
    ):
        found = [data[position + RECORD.size : end] for position, end in summary[opcode]]
        if found and sorted(found) != sorted(expected):
            raise ValueError(f'ambiguous: the index of the {what} disagrees with the {what}')


def _check_chunk_indexes(
    data: bytes, summary: Summary, contents: Contents, messages: Messages
) -> None:
    """Raise ValueError if chunk indexes exist and are wrong, or times in a chunk header are."""
    _check_chunk_times(contents, messages)
    if not summary[Opcode.CHUNK_INDEX]:
        return
    where: dict[int, list[tuple[int, int]]] = defaultdict(list)
    length: Counter[int] = Counter()
    for index in contents.message_indexes:
        where[index.chunk].append((index.channel, index.position))
        length[index.chunk] += _INDEX_BYTES + len(index.entries)
    chunks = {chunk.position: number for number, chunk in enumerate(contents.chunks)}
    for position, end in summary[Opcode.CHUNK_INDEX]:
        fields = _fields(data, position, end)
        first, last, chunk_position, chunk_length, size = fields.numbers(_CHUNK_INDEX)
        offsets = fields.bytes(size)
        described = ((first, last), chunk_length, fields.number(8), fields.text())
        number = chunks.pop(chunk_position, -1)
        chunk = contents.chunks[number] if number >= 0 else None
        if chunk is None or (*described, *fields.numbers(_CHUNK_SIZES)) != (
            chunk.times,
            chunk.length,
            length[number],
            chunk.compression,
            chunk.packed_bytes,
            chunk.unpacked_bytes,
        ):
            raise ValueError('ambiguous: a chunk index disagrees with its chunk')
        fields.end()
        if len(offsets) % _INDEX_OFFSET.size or sorted(where[number]) != sorted(
            _INDEX_OFFSET.iter_unpack(offsets)
        ):
            raise ValueError('ambiguous: a chunk index disagrees with the message indexes')
    if chunks or contents.messages_outside:
        raise ValueError('ambiguous: messages that the chunk indexes leave out')


def _check_chunk_times(contents: Contents, messages: Messages) -> None:
    """Raise ValueError if first and last time in a chunk header are wrong; (0, 0) is allowed."""
    order = np.argsort(messages.starts)
    starts, times = messages.starts[order], messages.headers['log_time'][order]
    for chunk in contents.chunks:
        first, last = np.searchsorted(starts, (chunk.base, chunk.base + chunk.unpacked_bytes))
        found = times[first:last]
        if chunk.times != (0, 0) and found.size:
            if chunk.times != (int(found.min()), int(found.max())):
                raise ValueError('ambiguous: a chunk has other times than its messages')


def _check_message_indexes(contents: Contents, messages: Messages) -> None:
    """Raise ValueError if the file has message indexes that do not list exactly its messages."""
    if not contents.message_indexes:
        return
    found = contents.message_indexes
    counts = [len(index.entries) // 16 for index in found]
    bases = np.array([contents.chunks[index.chunk].base for index in found], np.uint64)
    indexed = np.frombuffer(b''.join(index.entries for index in found), '<u8').reshape(-1, 2)
    starts = np.repeat(bases, counts) + indexed[:, 1]
    channels = np.repeat([index.channel for index in found], counts)
    order = np.argsort(starts)
    expected = np.argsort(messages.starts)
    for given, known in (
        (starts, messages.starts.astype(np.uint64)),
        (indexed[:, 0], messages.headers['log_time']),
        (channels, messages.headers['channel']),
    ):
        if not np.array_equal(given[order], known[expected]):
            raise ValueError('ambiguous: the message indexes disagree with the messages')


def _check_statistics(
    data: bytes, summary: Summary, contents: Contents, messages: Messages
) -> None:
    """Raise ValueError if the statistics are wrong; counts except that of messages may be 0."""
    if len(summary[Opcode.STATISTICS]) > 1:
        raise ValueError('ambiguous: two records of statistics')
    for position, end in summary[Opcode.STATISTICS]:
        fields = _fields(data, position, end)
        message_count, *counts, first, last, size = fields.numbers(_STATISTICS)
        per_channel = dict(_INDEX_OFFSET.iter_unpack(fields.bytes(size)))
        fields.end()
        found = messages.headers['log_time']
        span = (int(found[0]), int(found[-1])) if found.size else (first, last)
        known = (
            len(contents.schemas),
            len(contents.channels),
            len(contents.attachments),
            len(contents.metadata),
            len(contents.chunks),
        )
        ids, numbers = np.unique(messages.headers['channel'], return_counts=True)
        expected = dict(zip(ids.tolist(), numbers.tolist(), strict=True))
        if (
            message_count != found.size
            or (first, last) != span
            or any(given not in (0, count) for given, count in zip(counts, known, strict=True))
            or (per_channel and {id: n for id, n in per_channel.items() if n} != expected)
        ):
            raise ValueError('ambiguous: the statistics disagree with the contents')
