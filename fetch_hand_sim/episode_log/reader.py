"""Reads an episode back: raw messages per topic, metadata records, attachments."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import zstandard
from mcap.exceptions import McapError
from mcap.reader import McapReader, make_reader

from fetch_hand_sim.episode_log.errors import EpisodeReadError
from fetch_hand_sim.episode_log.writer import EPISODE, EPISODE_RESULT

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
class Episode:
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

    @property
    def is_complete(self) -> bool:
        """Whether the episode ran to its end; False if it was interrupted."""
        return self.result.get('complete') == 'true'


def read_episode(path: Path) -> Episode:
    """Reads an episode with all checks.

    Args:
        path: The bag directory, or its MCAP file.

    Raises:
        EpisodeReadError: If there is no such file, or it is truncated, damaged or no episode.
    """
    file = _mcap_file(path)
    with _one_line(file), file.open('rb') as stream:
        reader = make_reader(stream, validate_crcs=True)
        records = {record.name: dict(record.metadata) for record in reader.iter_metadata()}
        for name in (EPISODE, EPISODE_RESULT):
            if name not in records:
                raise EpisodeReadError(f'no episode: there is no metadata record {name!r}')
        return Episode(
            path=file,
            topics=_topics(reader),
            metadata=records[EPISODE],
            result=records[EPISODE_RESULT],
            attachments={item.name: item.data for item in reader.iter_attachments()},
        )


def _topics(reader: McapReader) -> dict[str, LoggedTopic]:
    topics: dict[str, LoggedTopic] = {}
    for schema, channel, message in reader.iter_messages():
        if schema is None:
            raise EpisodeReadError(f'topic {channel.topic} has no message type')
        if channel.topic not in topics:
            topics[channel.topic] = LoggedTopic(
                type_name=schema.name,
                qos_yaml=channel.metadata.get('offered_qos_profiles', ''),
                type_hash=channel.metadata.get('topic_type_hash', ''),
            )
        topics[channel.topic].messages.append(
            LoggedMessage(message.log_time, message.sequence, message.data)
        )
    return topics


def _mcap_file(path: Path) -> Path:
    if not path.is_dir():
        return path
    files = sorted(path.glob('*.mcap'))
    if len(files) != 1:
        raise EpisodeReadError(
            f'{path} holds {len(files)} MCAP files; an episode is a directory of one'
        )
    return files[0]


@contextmanager
def _one_line(file: Path) -> Iterator[None]:
    """Says in one line what is wrong with a file, whatever noticed it."""
    try:
        yield
    except EpisodeReadError as error:
        raise EpisodeReadError(f'{file}: {error}') from None
    except OSError as error:
        raise EpisodeReadError(f'{file}: {error.strerror or error}') from error
    except DAMAGED as error:
        text = ' '.join(str(error).split()) or type(error).__name__
        raise EpisodeReadError(f'{file}: truncated, damaged or no MCAP file ({text})') from error
