"""Write episode files: messages, metadata and result.

All messages of a tick have the same stamp, but log times must grow. So message number r of a tick,
counted from 0, has the log time stamp + r nanoseconds. Messages that the robot publishes come
first. Messages that it receives before the next tick follow, in the order they arrive. So a command
lies between the state from which it was computed and the state to which it leads.
"""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from fetch_hand_sim.episode_log import files
from fetch_hand_sim.episode_log.bag import Attachment, BagFile, checked_strings
from fetch_hand_sim.episode_log.files import EpisodeExistsError, EpisodeLogError
from fetch_hand_sim.episode_log.records import (
    MAX_ATTACHMENT_BYTES,
    MAX_CHUNKS,
    MAX_RECEIVED_BYTES,
    MAX_RECEIVED_MESSAGES,
)
from msgs_spec.schemas import MAX_MESSAGE_BYTES
from msgs_spec.topics import TopicSpec

# Simulated time after which messages are handed to the operating system. The next tick does that,
# so a killed process loses up to a tick more: less than a quarter of a second at 12.5 Hz.
FLUSH_PERIOD_NS = 150_000_000
# No episode is begun with less free space on the disk.
MINIMUM_FREE_BYTES = 64 * 2**20
_NAME = re.compile(r'\.?(?P<task>.+)_(?P<index>\d+)_seed(?P<seed>\d+)(\.active|\.aside)?')


class ReceivedAllowance:
    """Limits the received messages of an episode that are logged, in number and bytes per topic.

    `omitted` is the number of messages that are not logged, by topic.
    """

    def __init__(self) -> None:
        self.omitted: Counter[str] = Counter()
        self._messages: Counter[str] = Counter()
        self._bytes: Counter[str] = Counter()

    def accepts(
        self, topic: str, size: int, has_room: bool = True, *, is_refused: bool = False
    ) -> bool:
        """Count a received message of `size` bytes; return whether to log it.

        `has_room=False` means that the file is full: the message is not logged. Messages that the
        robot rejected (`is_refused`) may use at most half of each limit, so that room remains for
        valid messages. `omitted` lists those not logged as `<topic> (refused)`.
        """
        share = 2 if is_refused else 1
        if (
            not has_room
            or size > MAX_MESSAGE_BYTES
            or self._messages[topic] >= MAX_RECEIVED_MESSAGES // share
            or self._bytes[topic] + size > MAX_RECEIVED_BYTES // share
        ):
            self.omitted[f'{topic} (refused)' if is_refused else topic] += 1
            return False
        self._messages[topic] += 1
        self._bytes[topic] += size
        return True


class EpisodeWriter:
    """Writes one episode as a rosbag2 bag.

    The bag is written into the hidden directory `.<name>.active`; `finish` completes it and renames
    the directory to `<name>`. A killed process leaves the hidden directory behind, see
    `find_leftovers`.

    A disk error is raised once. After it, `write_tick` returns False and `finish` returns None, so
    the simulation can continue. Not thread-safe, and not for use in signal handlers.

    The number of received messages is limited; the record `episode_result` counts those beyond the
    limit.

    Raises:
        EpisodeExistsError: If the name is taken; episodes are never overwritten.
        EpisodeLogError: If the disk is too full or the file cannot be written. Then no file is left
            behind.
        ValueError: If metadata or attachments are too long.
    """

    def __init__(
        self,
        directory: Path | str,
        name: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
        namespace: str = '/',
    ) -> None:
        metadata = {'episode_id': name, **checked_strings(metadata)}
        attached = sum(len(each.data) for each in attachments)
        if attached > MAX_ATTACHMENT_BYTES:
            raise ValueError(f'{attached} bytes attached; allowed: {MAX_ATTACHMENT_BYTES}')
        self._namespace = namespace.rstrip('/') + '/'
        directory = Path(directory)
        self._final = directory / name
        self._flushed_ns: int | None = None
        self._tick_ns: int | None = None
        self._rank = 0
        self._received = ReceivedAllowance()
        self._description: str | None = None
        try:
            directory.mkdir(parents=True, exist_ok=True)
            files.require_free_space(directory, MINIMUM_FREE_BYTES)
            self._stream = files.claim(directory, name)
        except OSError as error:
            raise EpisodeLogError(f'cannot log episode {self._final}: {_reason(error)}') from error
        self._active = files.active_path(directory, name)
        self._is_open = True
        try:
            file_name = Path(self._stream.name).name
            self._bag = BagFile(self._stream, file_name, metadata, attachments)
        except (OSError, ValueError) as error:
            self.discard()
            if isinstance(error, ValueError):
                raise
            raise EpisodeLogError(f'cannot log episode {self._final}: {_reason(error)}') from error

    def write_tick(self, stamp_ns: int, messages: Iterable[tuple[TopicSpec, bytes]]) -> bool:
        """Append the messages (topic, CDR bytes) of a tick; return False after an error or `end`.

        Raises:
            EpisodeLogError: At the first disk error, or if the file is full. The part written
                before can be recovered.
        """
        self._tick_ns, self._rank = stamp_ns, 0
        for topic, data in messages:
            self._append(topic, data)
        self._flushed_ns = stamp_ns if self._flushed_ns is None else self._flushed_ns
        if stamp_ns - self._flushed_ns >= FLUSH_PERIOD_NS:
            self.flush()
        return self._is_open

    def write_received(self, topic: TopicSpec, data: bytes, *, is_refused: bool = False) -> bool:
        """Append a message received since the last tick; return whether it is logged.

        Returns False beyond the limits of `ReceivedAllowance` or of the file, after an error, or
        after `end`. `is_refused` marks a message that the robot rejected; half of a limit applies.

        Raises:
            EpisodeLogError: At the first disk error.
            ValueError: Before the first tick: earlier messages are not part of the episode.
        """
        if not self._is_open:
            return False
        # A paused robot flushes what it receives again and again.
        has_room = self._bag.has_room(len(data)) and self._bag.chunks <= MAX_CHUNKS // 2
        if not self._received.accepts(topic.name, len(data), has_room, is_refused=is_refused):
            return False
        return self._append(topic, data)

    def flush(self) -> None:
        """Pass all messages to the operating system; EpisodeLogError if the disk fails."""
        if self._is_open:
            try:
                self._bag.flush()
            except OSError as error:
                raise self._fail(error) from error
            self._flushed_ns = self._tick_ns

    @property
    def has_unflushed(self) -> bool:
        """True if a message was not yet passed to the operating system."""
        return self._is_open and self._bag.has_unflushed

    def finish(self, result: Mapping[str, str], reason: str | None = None) -> Path | None:
        """Complete the bag; return its directory, None without messages or after an earlier error.

        If the bag cannot be completed, EpisodeLogError is raised and the hidden directory stays.

        Args:
            result: The record `episode_result`; `complete` and `reason` are added.
            reason: Why the episode was cut short; None if it ended normally.
        """
        self.end(result, reason)
        return self.store()

    def end(self, result: Mapping[str, str], reason: str | None = None) -> None:
        """Write the last messages, the result and the summary, so that `store` can follow.

        If the process is killed before `store`, recovery finds the whole episode.
        """
        record = {**result, 'complete': 'true' if reason is None else 'false'}
        if reason is not None:
            record['reason'] = reason
        if self._received.omitted:
            record['received_not_logged'] = json.dumps(self._received.omitted)
        record = checked_strings(record)
        if self._bag.message_count == 0:
            self.discard()
        if not self._is_open:
            return
        self._is_open = False
        try:
            self._description = self._bag.finish(record)
        except OSError as error:
            raise self._fail(error) from error

    def store(self) -> Path | None:
        """Sync and rename the bag; return its directory, or None if no bag waits for it."""
        if self._description is None:
            return None
        try:
            files.store(self._stream, self._active, self._description)
            files.publish(self._active, self._final)
        except OSError as error:
            raise self._fail(error) from error
        self._description = None
        self._stop()
        return self._final

    def discard(self) -> None:
        """Remove the files of an episode that is still being written."""
        if self._is_open:
            self._stop()
            shutil.rmtree(self._active, ignore_errors=True)

    def _append(self, topic: TopicSpec, data: bytes) -> bool:
        if not self._is_open:
            return False
        if self._tick_ns is None:
            raise ValueError(f'{topic.name} was written before the first tick of the episode')
        name = topic.name if topic.name.startswith('/') else self._namespace + topic.name
        try:
            self._bag.write(name, topic, data, self._tick_ns + self._rank)
        except OSError as error:
            raise self._fail(error) from error
        self._rank += 1
        return True

    def _fail(self, error: OSError) -> EpisodeLogError:
        self._description = None
        self._stop()
        return EpisodeLogError(f'episode log stopped, {self._stream.name}: {_reason(error)}')

    def _stop(self) -> None:
        """Close the MCAP file, which releases the lock that marks it as being written."""
        self._is_open = False
        with suppress(OSError):
            self._stream.close()


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


# Directories of episodes


def episode_name(task: str, index: int, seed: int) -> str:
    """Return `<task>_<index>_seed<seed>`; leading zeros of the index sort names by number."""
    return f'{task}_{index:06d}_seed{seed}'


def named_seeds(directory: Path, task: str) -> set[int]:
    """Return the seeds in the names of the episodes of a task in a directory."""
    return {int(name['seed']) for name in _names(directory, task)}


def _names(directory: Path, task: str) -> Iterator[re.Match[str]]:
    if directory.is_dir():
        for path in directory.iterdir():
            if (name := _NAME.fullmatch(path.name)) and name['task'] == task:
                yield name


class EpisodeDirectory:
    """Creates the writers of numbered episodes in a directory.

    Numbers continue after those of existing episodes, so no episode is overwritten. Several
    processes may share the directory. A name belongs to the first process that creates its hidden
    directory. Another process uses the next number for the same seed; with another seed it may use
    the same number.
    """

    def __init__(self, path: Path | str, namespace: str = '/') -> None:
        self.path = Path(path)
        self._namespace = namespace
        self._next: dict[str, int] = {}

    def begin(
        self,
        task: str,
        seed: int,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
    ) -> EpisodeWriter:
        """Begin the next episode of a task; return its writer. For errors see `EpisodeWriter`."""
        index = self._next[task] if task in self._next else self._first_index(task)
        while True:
            name = episode_name(task, index, seed)
            try:
                writer = EpisodeWriter(self.path, name, metadata, attachments, self._namespace)
            except EpisodeExistsError:
                index += 1
            else:
                self._next[task] = index + 1
                return writer

    def _first_index(self, task: str) -> int:
        try:
            return max((int(name['index']) + 1 for name in _names(self.path, task)), default=0)
        except OSError as error:
            raise EpisodeLogError(
                f'cannot log episodes in {self.path}: {error.strerror}'
            ) from error
