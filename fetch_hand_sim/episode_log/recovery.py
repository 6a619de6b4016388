"""Makes a valid bag of a cut-off episode: what reached the disk, marked as interrupted."""

from __future__ import annotations

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, BinaryIO

from mcap import records
from mcap.exceptions import EndOfFile
from mcap.writer import MCAP0_MAGIC

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.bag_metadata import ChannelSpec
from fetch_hand_sim.episode_log.episode_bag import (
    EPISODE,
    EPISODE_RESULT,
    begin_bag,
    checked_strings,
    end_bag,
    store_bag,
)
from fetch_hand_sim.episode_log.episode_record import EpisodeOutcome
from fetch_hand_sim.episode_log.errors import EpisodeInUseError, EpisodeLogError
from fetch_hand_sim.episode_log.leftovers import inspect_leftover
from fetch_hand_sim.episode_log.limits import ReceivedAllowance
from fetch_hand_sim.episode_log.offered_qos import parse_offered_qos
from fetch_hand_sim.episode_log.reader import DAMAGED, read_episode
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings
from fetch_hand_sim.episode_log.untrusted import RECOVERY_LIMITS, read_records
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS
from msgs_spec.text import one_line
from msgs_spec.topics import relative_name, topics

_RECEIVED = frozenset(
    spec.name for task in TASKS.values() for spec in topics(task) if spec.direction == 'subscribed'
)


@dataclass(slots=True)
class _Remains:
    """What can be read of a file, up to the first damage."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    messages: list[records.Message] = field(default_factory=list)
    is_torn: bool = False
    is_whole: bool = False
    has_chunk: bool = False

    def take(self, record: records.McapRecord) -> None:
        match record:
            case records.Message():
                self.messages.append(record)
            case records.Chunk():
                self.has_chunk = True
            case records.Channel():
                self.channels[record.id] = record
            case records.Schema():
                self.schemas[record.id] = record
            case records.Attachment():
                self.attachments.append(Attachment(record.name, record.media_type, record.data))
            case records.Metadata():
                self.metadata[record.name] = dict(record.metadata)
            case records.Footer():
                self.is_whole = True

    @property
    def was_killed_at_the_start(self) -> bool:
        """Whether the file ends before its first whole chunk, and is not damaged so far."""
        return self.is_torn and not self.has_chunk

    @property
    def result(self) -> dict[str, str]:
        """How the episode ended; only a file that is whole knows."""
        if self.is_whole and EPISODE_RESULT in self.metadata:
            return self.metadata[EPISODE_RESULT]
        return self._outcome().to_strings()

    def _outcome(self) -> EpisodeOutcome:
        """Steps, return and success up to the last whole tick."""
        cut_off = EpisodeOutcome(is_complete=False, reason='cut off, recovered later')
        # `applied_command` comes last among the topics with a number per tick.
        steps = len(self._values('applied_command'))
        rewards, successes = self._values('reward'), self._values('is_success')
        if len(rewards) < steps or len(successes) <= steps:
            return cut_off
        return replace(
            cut_off,
            steps=steps,
            episode_return=float(sum(rewards[:steps])),
            is_success=bool(successes[steps]),
        )

    def _values(self, name: str) -> list[Any]:
        """The `data` of all messages of a topic of std_msgs."""
        types = {
            id: self.schemas[channel.schema_id].name
            for id, channel in self.channels.items()
            if relative_name(channel.topic) == name
        }
        found = [m for m in self.messages if m.channel_id in types]
        try:
            return [deserialize(types[m.channel_id], m.data).data for m in found]
        except ValueError:
            return []


def recover_episode(leftover: Path | str) -> Path | None:
    """Completes an episode that a crash cut off.

    All whole chunks become a bag under the name of the episode; at most the last quarter of a
    second is missing. The torn file is replaced when the new one has been read back. A process that
    was killed before it had written a first chunk leaves nothing to keep: that is cleared away.

    Args:
        leftover: Hidden directory of the episode, see `find_leftovers`.

    Returns:
        The bag directory; None if there was nothing to keep.

    Raises:
        EpisodeInUseError: If it is being written, or another process recovers it or has done so.
        EpisodeLogError: If it is not what a robot leaves, or the disk refuses.
    """
    leftover = Path(leftover)
    name = durable.active_name(leftover)
    if name is None:
        raise EpisodeLogError(f'{leftover} is no unfinished episode')
    found = inspect_leftover(leftover, now_s=0.0)
    if found is None:
        raise _in_use(leftover)
    if found.problem:
        raise EpisodeLogError(f'cannot recover episode {leftover}: {found.problem}')
    try:
        return _recover(leftover, name)
    except EpisodeLogError:
        raise
    except FileNotFoundError:
        raise _in_use(leftover) from None
    except OSError as error:
        reason = error.strerror or error
        raise EpisodeLogError(f'cannot recover episode {leftover}: {reason}') from error
    except DAMAGED as error:
        raise EpisodeLogError(f'cannot recover episode {leftover}: {one_line(error)}') from error


def _recover(leftover: Path, name: str) -> Path | None:
    file, final = durable.bag_file(leftover, name), leftover.parent / name
    if not file.exists():
        # A robot may begin its file right now: what it has just made stays, and so does the folder.
        durable.rewritten_file(file).unlink(missing_ok=True)
        durable.metadata_file(leftover).unlink(missing_ok=True)
        _remove_empty(leftover)
        return None
    with durable.open_regular(file) as torn:
        # Whoever recovers it holds the file and its replacement; after that it is another one.
        if not durable.try_lock(torn) or not os.fstat(torn.fileno()).st_nlink:
            raise _in_use(leftover)
        remains = _read(torn)
        if remains.was_killed_at_the_start:
            _clear_away(leftover)
            return None
        if final.exists():
            raise EpisodeLogError(
                f'{final} exists and is never overwritten; if {leftover.name} is an older copy of '
                'it, remove that'
            )
        with _replaced(file, remains):
            durable.publish(leftover, final)
    return final


def _in_use(leftover: Path) -> EpisodeInUseError:
    return EpisodeInUseError(f'{leftover} is being written, or another process has recovered it')


def _remove_empty(leftover: Path) -> None:
    try:
        leftover.rmdir()
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            raise _in_use(leftover) from None
        raise


def _clear_away(leftover: Path) -> None:
    for entry in leftover.iterdir():
        entry.unlink()
    leftover.rmdir()


def _read(stream: BinaryIO) -> _Remains:
    remains = _Remains()
    try:
        for record in read_records(stream, RECOVERY_LIMITS):
            remains.take(record)
    except EndOfFile:
        # Where the file ends as it should, the length of a record was damaged.
        stream.seek(max(0, stream.seek(0, os.SEEK_END) - len(MCAP0_MAGIC)))
        remains.is_torn = stream.read() != MCAP0_MAGIC
    except DAMAGED:
        pass
    return remains


@contextmanager
def _replaced(file: Path, remains: _Remains) -> Iterator[None]:
    """Writes the file anew and puts that in its place, locked until the end of the block."""
    if not remains.messages or EPISODE not in remains.metadata:
        raise EpisodeLogError(f'{file} is damaged before its first message: nothing to recover')
    rewritten = durable.rewritten_file(file)
    try:
        with durable.create(rewritten) as stream:
            durable.lock(stream)
            description = _write(stream, file, remains)
            store_bag(stream, file.parent, description)
            read_episode(rewritten)
            rewritten.replace(file)
            yield
    finally:
        rewritten.unlink(missing_ok=True)


def _write(stream: BinaryIO, file: Path, remains: _Remains) -> str:
    """Writes the file anew, as far as a writer would have gone; returns its description."""
    metadata = checked_strings(remains.metadata[EPISODE])
    bag = begin_bag(stream, file.name, LogSettings(), metadata, remains.attachments)
    specs = {id: _channel_spec(remains, channel) for id, channel in remains.channels.items()}
    received = ReceivedAllowance()
    for message in remains.messages:
        spec = specs[message.channel_id]
        name = relative_name(spec.topic)
        if name not in _RECEIVED or received.takes(name, len(message.data)):
            bag.write(spec, message.data, message.log_time)
    return end_bag(bag, stream, metadata, checked_strings(remains.result))


def _channel_spec(remains: _Remains, channel: records.Channel) -> ChannelSpec:
    schema = remains.schemas[channel.schema_id]
    return ChannelSpec(
        topic=channel.topic,
        type_name=schema.name,
        schema_text=schema.data.decode(),
        qos=parse_offered_qos(channel.metadata['offered_qos_profiles']),
        type_hash=channel.metadata['topic_type_hash'],
    )
