"""What an episode is and how it ended, from the records at its ends: no message is read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Footer, McapRecord, Metadata, MetadataIndex, Statistics
from mcap.stream_reader import read_magic

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.episode_record import HasOutcome
from fetch_hand_sim.episode_log.errors import EpisodeReadError
from fetch_hand_sim.episode_log.limits import MAX_METADATA_RECORDS
from fetch_hand_sim.episode_log.reader import (
    check_summary,
    episode_records,
    is_mcap,
    mcap_file,
    one_line_errors,
)
from fetch_hand_sim.episode_log.untrusted import BoundedStream, Records
from msgs_spec.text import first_of, printable

_MAGIC_BYTES = 8
# Folders that are named where the one above was given.
_NAMED = 3
# Opcode, length, two offsets and a CRC.
_FOOTER_BYTES = 1 + 8 + 8 + 8 + 4
_AT_THE_END = frozenset({Opcode.FOOTER, Opcode.STATISTICS, Opcode.METADATA_INDEX})


@dataclass(frozen=True, slots=True)
class EpisodeSummary(HasOutcome):
    """An episode without its messages.

    Attributes:
        path: The MCAP file.
        metadata: The record `episode`.
        result: The record `episode_result`.
        message_count: Messages in the file.
        duration_s: Simulated seconds from the first message to the last.
        size_bytes: Size of the file.
    """

    path: Path
    metadata: dict[str, str]
    result: dict[str, str]
    message_count: int
    duration_s: float
    size_bytes: int


def read_summary(path: Path | str) -> EpisodeSummary:
    """Reads what the end of a file says of it, about 1 ms whatever its size.

    The CRC of the summary is checked, that of the messages is not: `read_episode` does that.

    Args:
        path: The bag directory, or its MCAP file.

    Raises:
        EpisodeReadError: If there is no such file, or it is truncated, damaged or no episode.
    """
    file = mcap_file(Path(path))
    with one_line_errors(file), file.open('rb') as stream:
        records = list(_summary_records(stream))
        statistics = next((r for r in records if isinstance(r, Statistics)), None)
        if statistics is None:
            raise ValueError('no statistics')
        indexes = [r for r in records if isinstance(r, MetadataIndex)][:MAX_METADATA_RECORDS]
        found = {index.name: _metadata_at(stream, index) for index in indexes}
        size = file.stat().st_size
    metadata, result = episode_records(file, found)
    return EpisodeSummary(
        path=file,
        metadata=metadata,
        result=result,
        message_count=statistics.message_count,
        duration_s=(statistics.message_end_time - statistics.message_start_time) / 1e9,
        size_bytes=size,
    )


def _summary_records(stream: BinaryIO) -> Iterator[McapRecord]:
    read_magic(ReadDataStream(BytesIO(stream.read(_MAGIC_BYTES))))
    end = stream.seek(0, 2)
    footer_start = end - _MAGIC_BYTES - _FOOTER_BYTES
    stream.seek(max(0, footer_start))
    footer = next(Records(BytesIO(stream.read()), _AT_THE_END).records)
    if not isinstance(footer, Footer):
        raise ValueError('no footer')
    if not 0 < footer.summary_start <= footer_start:
        raise ValueError('no summary')
    check_summary(stream, footer.summary_start, footer.summary_crc)
    stream.seek(footer.summary_start)
    yield from Records(BytesIO(stream.read()), _AT_THE_END).records


def _metadata_at(stream: BinaryIO, index: MetadataIndex) -> dict[str, str]:
    stream.seek(index.offset)
    record = next(Records(BoundedStream(stream), frozenset({Opcode.METADATA})).records)
    if not isinstance(record, Metadata) or record.name != index.name:
        raise ValueError(f'no metadata record {index.name!r} where the summary says')
    return dict(record.metadata)


def find_episodes(directory: Path | str) -> list[Path]:
    """Returns what may be an episode in a directory, by name; nothing is opened.

    These are bag directories and MCAP files, but not the hidden directories of episodes that are
    being written or were cut off, see `find_leftovers`.

    Raises:
        EpisodeReadError: If it is no directory or cannot be read.
    """
    try:
        entries = sorted(Path(directory).iterdir())
        return [path for path in entries if not durable.active_name(path) and _is_bag(path)]
    except OSError as error:
        raise EpisodeReadError(f'{error.filename or directory}: {error.strerror}') from error


def folders_below(directory: Path) -> str:
    """Names the first folders in a directory that hold episodes, for who named the one above."""
    try:
        folders = [path for path in sorted(directory.iterdir()) if path.is_dir()]
        held = [path for path in folders if path.name[0] != '.' and find_episodes(path)]
    except (OSError, EpisodeReadError):
        return ''
    return first_of([printable(str(path)) for path in held], _NAMED)


def holds_no_episode(directory: Path) -> EpisodeReadError:
    """The error of who needs an episode and got a folder without any."""
    below = folders_below(directory)
    return EpisodeReadError(
        f'{directory} holds no episode{f"; there are some in {below}" if below else ""}'
    )


def expand_episodes(path: Path | str) -> list[Path]:
    """Returns the path itself if it is an episode or no directory, else the episodes in it.

    Raises:
        EpisodeReadError: If it does not exist, or is a directory that cannot be read.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise EpisodeReadError(f'{path}: No such file or directory')
        if not path.is_dir() or durable.metadata_file(path).exists():
            return [path]
    except OSError as error:
        raise EpisodeReadError(f'{path}: {error.strerror}') from error
    return find_episodes(path)


def _is_bag(path: Path) -> bool:
    try:
        if path.is_dir():
            return durable.metadata_file(path).exists() or any(map(is_mcap, path.glob('*.mcap')))
    except OSError:
        return True  # Whoever reads it will hear why it cannot be read.
    return is_mcap(path)
