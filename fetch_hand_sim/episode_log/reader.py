"""Reads an episode back: raw messages per topic, metadata records, attachments."""

from __future__ import annotations

import shlex
import struct
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Footer, McapRecord, Message, Metadata, Schema

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.episode_bag import EPISODE, EPISODE_RESULT
from fetch_hand_sim.episode_log.episode_record import HasOutcome
from fetch_hand_sim.episode_log.errors import EpisodeReadError
from fetch_hand_sim.episode_log.limits import MAX_SUMMARY_BYTES
from fetch_hand_sim.episode_log.untrusted import read_records, require_size
from msgs_spec.text import one_line

# CRC of the summary and magic, bytes.
FILE_END = 4 + 8

# What the mcap package and its decompressors raise on damaged bytes.
DAMAGED = (
    McapError,
    ValueError,
    KeyError,
    IndexError,
    OverflowError,
    MemoryError,
    RuntimeError,
    EOFError,
    struct.error,
    zstandard.ZstdError,
)


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """One message.

    Attributes:
        log_time_ns: Simulated time plus rank, see `log_times`.
        sequence: Number of the message in its topic, from 0.
        data: CDR bytes; `msgs_spec.schemas.deserialize` reads them.
    """

    log_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class LoggedTopic:
    """A topic of an episode.

    Attributes:
        type_name: ROS name of the message type.
        qos_yaml: Offered quality of service, rosbag2 YAML.
        type_hash: RIHS01 hash of the type.
        messages: Messages in order of log time.
    """

    type_name: str
    qos_yaml: str
    type_hash: str
    messages: list[LoggedMessage] = field(default_factory=list)


@dataclass(frozen=True, slots=True)
class Episode(HasOutcome):
    """What a file says.

    Attributes:
        path: The MCAP file.
        topics: By resolved name, in order of the first message.
        metadata: The record `episode`.
        result: The record `episode_result`.
        attachments: Contents by file name.
    """

    path: Path
    topics: dict[str, LoggedTopic]
    metadata: dict[str, str]
    result: dict[str, str]
    attachments: dict[str, bytes]


def read_episode(path: Path | str) -> Episode:
    """Reads an episode with all checks.

    Args:
        path: The bag directory, or its MCAP file.

    Raises:
        EpisodeReadError: If there is no such file, or it is truncated, damaged or no episode.
    """
    file = mcap_file(Path(path))
    contents = _Contents()
    with one_line_errors(file), file.open('rb') as stream:
        for record in read_records(stream):
            contents.take(record)
        check_summary(stream, contents.summary_start, contents.summary_crc)
    metadata, result = episode_records(file, contents.metadata)
    return Episode(file, contents.topics, metadata, result, contents.attachments)


class _Contents:
    """What the records of a file add up to."""

    def __init__(self) -> None:
        self.topics: dict[str, LoggedTopic] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, bytes] = {}
        self.summary_start = 0
        self.summary_crc = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, LoggedTopic] = {}

    def take(self, record: McapRecord) -> None:
        match record:
            case Message():
                self._channels[record.channel_id].messages.append(
                    LoggedMessage(record.log_time, record.sequence, record.data)
                )
            case Metadata():
                self.metadata[record.name] = dict(record.metadata)
            case Attachment():
                self.attachments[record.name] = record.data
            case Footer():
                self.summary_start, self.summary_crc = record.summary_start, record.summary_crc
            case Schema():
                self._schemas[record.id] = record
            case Channel() if record.id not in self._channels:
                self.topics[record.topic] = self._channels[record.id] = LoggedTopic(
                    type_name=self._schemas[record.schema_id].name,
                    qos_yaml=record.metadata.get('offered_qos_profiles', ''),
                    type_hash=record.metadata.get('topic_type_hash', ''),
                )


def episode_records(
    file: Path, records: Mapping[str, dict[str, str]]
) -> tuple[dict[str, str], dict[str, str]]:
    """Returns what makes a file an episode: its records `episode` and `episode_result`.

    Raises:
        EpisodeReadError: If one is missing.
    """
    for name in (EPISODE, EPISODE_RESULT):
        if name not in records:
            reason = _unfinished(file) or f'no episode, there is no metadata record {name!r}'
            raise EpisodeReadError(f'{file}: {reason}')
    return records[EPISODE], records[EPISODE_RESULT]


def check_summary(stream: BinaryIO, start: int, expected_crc: int) -> None:
    """Checks the one CRC that `StreamReader` leaves out; it covers all but itself and the magic."""
    if require_size(stream) - start > MAX_SUMMARY_BYTES:
        raise ValueError(f'summary larger than {MAX_SUMMARY_BYTES} bytes')
    stream.seek(start)
    if expected_crc not in (0, zlib.crc32(stream.read()[:-FILE_END])):
        raise ValueError('crc validation failed in Summary')


def mcap_file(path: Path) -> Path:
    """Returns the MCAP file of a bag directory, or the path itself if it is no directory.

    Raises:
        EpisodeReadError: If the directory does not hold exactly one, or cannot be read.
    """
    try:
        if not path.is_dir():
            if path.exists() and not path.is_file():
                raise EpisodeReadError(f'{path} is no regular file')  # A pipe would never end.
            return path
        # `glob` finds nothing where it may not look.
        files = sorted(file for file in path.iterdir() if is_mcap(file) and file.is_file())
    except OSError as error:
        raise EpisodeReadError(f'{path}: {error.strerror}') from error
    if len(files) != 1:
        raise EpisodeReadError(
            f'{path} holds {len(files)} MCAP files; an episode is a directory of one'
        )
    return files[0]


def is_mcap(path: Path) -> bool:
    """Whether a name is that of an MCAP file, and of none that macOS puts beside it in archives."""
    return path.suffix == '.mcap' and not path.name.startswith('._')


@contextmanager
def one_line_errors(file: Path) -> Iterator[None]:
    """Says in one line what is wrong with a file, whatever noticed it."""
    try:
        yield
    except OSError as error:
        raise EpisodeReadError(f'{file}: {error.strerror or error}') from error
    except DAMAGED as error:
        reason = _unfinished(file) or f'truncated, damaged or no MCAP file ({one_line(error)})'
        raise EpisodeReadError(f'{file}: {reason}') from error


def _unfinished(file: Path) -> str:
    """What to say of a file in the hidden directory of an episode; empty for others."""
    if durable.active_name(file.parent) is None:
        return ''
    with suppress(OSError):
        if durable.is_locked(file):
            return 'still being written'
    directory = shlex.quote(str(file.parent.parent))
    return (
        f'truncated by a kill or a full disk; `fetch_hand_sim episodes recover {directory}` ends it'
    )
