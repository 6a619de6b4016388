"""Read episode files. All commands use `read_episode`, so they accept the same files."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields
from functools import cached_property, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import get_types_from_msg
from rosbags.typesys.base import TypesysError

from fetch_hand_sim.episode_log import files
from fetch_hand_sim.episode_log.bag import EPISODE, EPISODE_RESULT
from fetch_hand_sim.episode_log.files import EpisodeReadError
from fetch_hand_sim.episode_log.indexes import parse_file
from fetch_hand_sim.episode_log.metadata import HasOutcome, parse_task
from fetch_hand_sim.episode_log.records import (
    MAX_FILE_BYTES,
    MESSAGE,
    MESSAGE_FIELD_BYTES,
    Channel,
    Contents,
    Messages,
    Schema,
    shown,
)
from msgs_spec.codecs import message_stamp
from msgs_spec.schemas import deserialize, schema_text
from msgs_spec.tasks import TaskSpec
from msgs_spec.text import one_line
from msgs_spec.topics import TopicSpec, ground_truth_topics, relative_name, topics

_CLOCK = '/clock'
# Characters of a message definition without comments; the longest of the contract has 1,700.
_LONGEST_SCHEMA = 8000
_NO_SCHEMA = Schema('none', '', b'')


@dataclass(frozen=True, slots=True)
class LoggedMessage:
    """A message of an episode; `sequence` is its index in its topic, `data` are CDR bytes."""

    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes


@dataclass(frozen=True, slots=True)
class LoggedTopic:
    """A topic of an episode with its messages, sorted by log time.

    `qos_yaml` is the QoS profile of the publisher, in the format of rosbag2.
    """

    type_name: str
    qos_yaml: str
    type_hash: str
    messages: list[LoggedMessage] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class EpisodeSummary(HasOutcome):
    """An episode without its messages; `path` is the MCAP file.

    Attributes:
        metadata: The metadata record `episode`, which describes the episode.
        result: The metadata record `episode_result`, which describes how it ended.
        duration_s: Simulated seconds from the first message to the last.
    """

    path: Path
    metadata: dict[str, str]
    result: dict[str, str]
    message_count: int
    duration_s: float
    size_bytes: int


@dataclass(frozen=True, eq=False)
class Episode(EpisodeSummary):
    """A valid episode with its messages; attachments by file name, schemas and channels by id."""

    attachments: dict[str, bytes]
    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    sorted_messages: Messages

    @cached_property
    def topics(self) -> dict[str, LoggedTopic]:
        """Topics by full name, in the order of their first messages."""
        found: dict[int, LoggedTopic] = {}
        for id, sequence, log_time, publish_time, data in self.sorted_messages.rows():
            if id not in found:
                channel = self.channels[id]
                schema = self.schemas.get(channel.schema_id)
                found[id] = LoggedTopic(
                    type_name=schema.name if schema else '',
                    qos_yaml=channel.metadata.get('offered_qos_profiles', ''),
                    type_hash=channel.metadata.get('topic_type_hash', ''),
                )
            found[id].messages.append(LoggedMessage(log_time, publish_time, sequence, data))
        return {self.channels[id].topic: logged for id, logged in found.items()}

    def count(self, name: str) -> int:
        """Return the number of messages of a topic, named without its namespace; 0 if unknown."""
        return len(self._indices(name))

    def rows(self, name: str) -> tuple[NDArray[np.int64], NDArray[np.uint8]]:
        """Return the log times (n,), ns, and the CDR bytes (n, size) of all messages of a topic.

        `name` has no namespace. No messages, or messages of different sizes, raise ValueError.
        """
        indices, messages = self._indices(name), self.sorted_messages
        starts, headers = messages.starts[indices], messages.headers[indices]
        sizes = headers['size']
        if not sizes.size or (sizes != sizes[0]).any():
            found = 'messages of several sizes' if sizes.size else 'no message'
            raise ValueError(f'{found} of {name}; one size is needed')
        size = int(sizes[0]) - MESSAGE_FIELD_BYTES
        buffer = np.frombuffer(messages.unpacked, np.uint8)
        data = buffer[starts[:, None] + np.arange(MESSAGE.itemsize, MESSAGE.itemsize + size)]
        return headers['log_time'].astype(np.int64), data

    def _indices(self, name: str) -> NDArray[np.int64]:
        for id, channel in self.channels.items():
            if relative_name(channel.topic) == name.lstrip('/'):
                return np.flatnonzero(self.sorted_messages.headers['channel'] == id)
        return np.zeros(0, dtype=np.int64)


def read_episode(path: Path | str) -> Episode:
    """Read and check an episode; `path` is a bag directory or an MCAP file.

    Raises:
        EpisodeReadError: If the file is missing, damaged or no episode, if its parts contradict
            each other, or if it has a topic that its task does not have.
    """
    file = files.mcap_file(Path(path))
    with one_line_errors(file):
        with file.open('rb') as stream:
            data = stream.read(MAX_FILE_BYTES + 1)
        if len(data) > MAX_FILE_BYTES:
            raise ValueError(f'a file of more than {MAX_FILE_BYTES} bytes')
        contents, messages = parse_file(data)
        records = {record.name: record.content for record in contents.metadata}
        for name in (EPISODE, EPISODE_RESULT):
            if name not in records:
                raise ValueError(
                    f'no episode, there is no metadata record {name!r}; some tools that convert '
                    'bags leave it out'
                )
        require_contract(records[EPISODE], contents)
        times = messages.headers['log_time']
        return Episode(
            path=file,
            metadata=records[EPISODE],
            result=records[EPISODE_RESULT],
            message_count=len(times),
            # Log times also contain the rank of a message in its tick, ns.
            duration_s=round((int(times[-1]) - int(times[0])) / 1e9, 6) if len(times) else 0.0,
            size_bytes=len(data),
            attachments={each.name: each.data for each in contents.attachments},
            schemas=contents.schemas,
            channels=contents.channels,
            sorted_messages=messages,
        )


@contextmanager
def one_line_errors(file: Path) -> Iterator[None]:
    """Convert errors in the block to `EpisodeReadError`, with one line that names the file."""
    try:
        yield
    except OSError as error:
        raise EpisodeReadError(f'{file}: {error.strerror or error}') from error
    except EpisodeReadError:
        raise
    except (ValueError, KeyError, MemoryError) as error:
        reason = _why_unfinished(file) or one_line(error)
        raise EpisodeReadError(f'{file}: {reason}') from error


def _why_unfinished(file: Path) -> str:
    """Return why the file of an unfinished episode is incomplete; '' for a finished episode."""
    active = file.absolute().parent
    if files.active_name(active) is None:
        return ''
    with suppress(OSError):
        if files.is_locked(file):
            return 'still being written'
    directory = shlex.quote(str(active.parent))
    return (
        f'truncated by a kill or a full disk; `fetch_hand_sim episodes recover {directory}` ends it'
    )


# The contract


def require_contract(metadata: dict[str, str], contents: Contents) -> None:
    """Raise ValueError if a parsed file has topics that the task in `metadata` does not allow.

    Name, type, encoding and message definition of each topic must be those of `contract_topics`.
    All topics must have the same namespace. A file with an unknown task is not checked.
    """
    try:
        task = parse_task(metadata)
    except ValueError:
        return
    known = contract_topics(task)
    namespaces = set()
    for channel in contents.channels.values():
        spec = known.get(relative_name(channel.topic))
        schema = contents.schemas.get(channel.schema_id, _NO_SCHEMA)
        if spec is None or spec.type_name != schema.name:
            raise ValueError(
                f'{task.name} has no topic {shown(channel.topic)} of type {shown(schema.name)}'
            )
        if (channel.encoding, schema.encoding) != ('cdr', 'ros2msg'):
            raise ValueError(
                f'{channel.topic} has the encodings {shown(channel.encoding)} and '
                f'{shown(schema.encoding)}; allowed: cdr, ros2msg'
            )
        if not _defines(spec.type_name, schema.text):
            raise ValueError(f'{channel.topic} has another definition of {schema.name} than ROS 2')
        if spec.name.startswith('/') and spec.name != channel.topic:
            raise ValueError(f'topic {shown(channel.topic)}; allowed: {spec.name}')
        if not spec.name.startswith('/'):
            namespaces.add(channel.topic.removesuffix(f'/{spec.name}'))
    if len(namespaces) > 1:
        found = ', '.join(map(shown, sorted(namespaces)[:3]))
        raise ValueError(f'topics in several namespaces, {found}; allowed: one')


@lru_cache(maxsize=256)
def contract_topics(task: TaskSpec) -> dict[str, TopicSpec]:
    """Return all topics that an episode of a task may contain, by name without leading slash."""
    specs = (*topics(task), *ground_truth_topics(task))
    return {spec.name.lstrip('/'): spec for spec in specs}


@lru_cache(maxsize=256)
def _defines(type_name: str, text: bytes) -> bool:
    """Return whether a definition in `ros2msg` has the same fields as the type in ROS 2 Jazzy."""
    expected = schema_text(type_name)
    if text == expected.encode():
        return True
    # Not `splitlines`: other readers do not end a comment at a form feed or at U+2028.
    lines = text.decode(errors='replace').split('\n')
    stripped = (line.partition('#')[0].strip() for line in lines)
    short = '\n'.join(line for line in stripped if line)
    if len(short) > _LONGEST_SCHEMA:
        return False
    try:
        found = get_types_from_msg(short, type_name)
    except (TypesysError, RecursionError, KeyError):
        return False
    known = get_types_from_msg(expected, type_name)
    return all(name in found and found[name][1] == fields for name, (_, fields) in known.items())


def read_summary(path: Path | str) -> EpisodeSummary:
    """Read and check an episode like `read_episode`; return it without its messages."""
    episode = read_episode(path)
    return EpisodeSummary(
        **{each.name: getattr(episode, each.name) for each in fields(EpisodeSummary)}
    )


# Episodes tick by tick


@dataclass(frozen=True, slots=True)
class TickMessage:
    """A message of a tick; the name in `topic` has no namespace."""

    topic: TopicSpec
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class LoggedTick:
    """All messages of one tick, in order: published by the robot, then received by it."""

    stamp_ns: int
    published: list[TickMessage] = field(default_factory=list)
    received: list[TickMessage] = field(default_factory=list)

    def find(self, name: str) -> TickMessage | None:
        """Return the robot's message on a topic, named without namespace; None if missing."""
        return next((m for m in self.published if m.topic.name == name), None)


def logged_topics(episode: Episode) -> dict[str, TopicSpec]:
    """Return the specification of each topic in an episode, by full topic name.

    An episode without messages, or of an unknown task, raises EpisodeReadError.
    """
    with one_line_errors(episode.path):
        known = contract_topics(parse_task(episode.metadata))
        if not episode.topics:
            raise ValueError('an episode without messages')
        return {name: known[relative_name(name)] for name in episode.topics}


def split_ticks(episode: Episode) -> list[LoggedTick]:
    """Divide an episode into its ticks; each `/clock` message begins a tick.

    Raises:
        EpisodeReadError: If the first message is not of `/clock`, or the task is unknown.
    """
    specs = logged_topics(episode)
    messages = (
        TickMessage(specs[episode.channels[id].topic], log_time, data)
        for id, _, log_time, _, data in episode.sorted_messages.rows()
    )
    ticks: list[LoggedTick] = []
    with one_line_errors(episode.path):
        for message in messages:
            if message.topic.name == _CLOCK:
                clock = deserialize(message.topic.type_name, message.data)
                ticks.append(LoggedTick(message_stamp(clock)))
            if not ticks:
                raise ValueError(f'the first message is of {message.topic.name}, not {_CLOCK}')
            is_published = message.topic.direction == 'published'
            (ticks[-1].published if is_published else ticks[-1].received).append(message)
    return ticks
