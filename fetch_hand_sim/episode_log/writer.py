"""Writes one episode: its messages, what they mean, and how it ended."""

from __future__ import annotations

import errno
import json
import shutil
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.bag_metadata import ChannelSpec
from fetch_hand_sim.episode_log.episode_bag import begin_bag, checked_strings, end_bag, store_bag
from fetch_hand_sim.episode_log.errors import EpisodeLogError
from fetch_hand_sim.episode_log.limits import (
    MAX_ATTACHMENT_BYTES,
    MAX_CHUNKS,
    MAX_MESSAGES,
    MAX_UNPACKED_BYTES,
    ReceivedAllowance,
)
from fetch_hand_sim.episode_log.log_times import log_time
from fetch_hand_sim.episode_log.offered_qos import offered_qos
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings
from msgs_spec.schemas import schema_text, type_hash
from msgs_spec.topics import TopicSpec

_TOO_LONG = (
    f'the episode is too long for a file of {MAX_MESSAGES} messages and '
    f'{MAX_UNPACKED_BYTES // 2**20} MiB of them'
)


def _reason(error: OSError) -> str:
    return error.strerror or str(error)


class EpisodeWriter:
    """A rosbag2 bag that appears in a directory under its name when it is complete, and not before.

    It is written in the hidden directory `.<name>.active`, from which `finish` or `abort` makes a
    valid bag. A process that is killed leaves the hidden directory behind, for `find_leftovers` to
    report.

    Whatever the disk does, the simulation can go on: an error is raised once, as one line; after it
    `write` does nothing and returns False, and `finish` returns None. Not thread-safe, and not for
    use in signal handlers.

    Nothing is written that a reader refuses, see `limits`. What comes from outside has an
    allowance; the rest of it is not logged, and the record `episode_result` counts it.

    Args:
        directory: Where episodes are collected; created if missing.
        name: Name of the episode, see `episode_name`.
        metadata: Contents of the metadata record `episode`, see `episode_metadata`; `episode_id`,
            the name, is added.
        attachments: Files to store.
        settings: How to write.
        namespace: ROS namespace of relative topic names.

    Raises:
        EpisodeExistsError: If the name is taken; episodes are never overwritten.
        EpisodeLogError: If the disk is too full or the file cannot be written; nothing is left
            behind.
        ValueError: If metadata are not strings, or these or the attachments are too long.
    """

    def __init__(
        self,
        directory: Path | str,
        name: str,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
        settings: LogSettings | None = None,
        namespace: str = '/',
    ) -> None:
        self._metadata = {'episode_id': name, **checked_strings(metadata)}
        attached = sum(len(each.data) for each in attachments)
        if attached > MAX_ATTACHMENT_BYTES:
            raise ValueError(f'{attached} bytes attached; allowed: {MAX_ATTACHMENT_BYTES}')
        self._settings = settings or LogSettings()
        self._namespace = namespace.rstrip('/') + '/'
        directory = Path(directory)
        self._final = directory / name
        self._channels: dict[str, ChannelSpec] = {}
        self._flushed_ns: int | None = None
        self._tick_ns: int | None = None
        self._rank = 0
        self._received = ReceivedAllowance()
        self._description: str | None = None
        self._completed: Path | None = None
        try:
            directory.mkdir(parents=True, exist_ok=True)
            durable.require_free_space(directory, self._settings.minimum_free_bytes)
            self._stream = durable.claim(directory, name)
        except OSError as error:
            raise EpisodeLogError(f'cannot log episode {self._final}: {_reason(error)}') from error
        self._active = durable.active_path(directory, name)
        self._is_open = True
        try:
            file_name = Path(self._stream.name).name
            self._bag = begin_bag(
                self._stream, file_name, self._settings, self._metadata, attachments
            )
        except OSError as error:
            self._discard()
            raise EpisodeLogError(f'cannot log episode {self._final}: {_reason(error)}') from error

    def write(self, topic: TopicSpec, data: bytes, log_time_ns: int) -> bool:
        """Appends a message.

        Args:
            topic: What it is.
            data: Its CDR bytes.
            log_time_ns: Simulated time, later than that of the message before, see `log_times`.

        Returns:
            True if the message was taken, False if the episode is completed or has failed.

        Raises:
            EpisodeLogError: At the first error of the disk.
            ValueError: If the time does not grow, the topic had another type before, or no reader
                would take a message more or as long.
        """
        if self._is_open and self._is_flush_due(log_time_ns):
            self._flush(log_time_ns)
        return self._append(topic, data, log_time_ns)

    def write_tick(self, stamp_ns: int, messages: Iterable[tuple[TopicSpec, bytes]]) -> bool:
        """Appends all messages of the tick stamped `stamp_ns`, in their order; see `write`.

        When it is due, they are handed to the operating system with it.

        Raises:
            EpisodeLogError: At the first error of the disk, or where the episode has become longer
                than readers take; what there is so far can be recovered.
        """
        self._tick_ns, self._rank = stamp_ns, 0
        for topic, data in messages:
            self._require_room(len(data))
            self._append_next(topic, data)
        if self._is_open and self._is_flush_due(stamp_ns):
            self._flush(stamp_ns)
        return self._is_open

    def write_received(self, topic: TopicSpec, data: bytes, *, is_refused: bool = False) -> bool:
        """Appends a message received since the last tick: it follows the messages of that tick.

        Args:
            topic: Of the message.
            data: CDR bytes.
            is_refused: Whether it decided nothing; such a one may be left out sooner.

        Returns:
            False if it is not taken: the allowance of its topic is used up, or see `write`.

        Raises:
            ValueError: If there was no tick yet: earlier commands are not part of the episode.
        """
        if not self._is_open:
            return False
        # While a robot is paused, what it receives is flushed without end.
        has_room = self._bag.takes(len(data)) and self._bag.chunks <= MAX_CHUNKS // 2
        if not self._received.takes(topic.name, len(data), has_room, is_refused=is_refused):
            return False
        return self._append_next(topic, data)

    def flush(self) -> None:
        """Hands what was written to the operating system, also if that is not due.

        Raises:
            EpisodeLogError: At the first error of the disk.
        """
        if self._is_open and self._tick_ns is not None:
            self._flush(log_time(self._tick_ns, self._rank))

    @property
    def has_unflushed(self) -> bool:
        """Whether something was written that the operating system does not have yet."""
        return self._is_open and self._bag.has_unflushed

    def finish(self, result: Mapping[str, str]) -> Path | None:
        """Completes the bag of an episode that ran to its end.

        Args:
            result: Contents of the metadata record `episode_result`; `complete` is added.

        Returns:
            The bag directory. None, and no bag, if writing had failed before or no message was
            written.

        Raises:
            EpisodeLogError: If the bag cannot be completed; the hidden directory stays.
            ValueError: If the result is not made of strings.
        """
        self.end(result)
        return self.store()

    def abort(self, reason: str, result: Mapping[str, str] | None = None) -> Path | None:
        """Completes the bag of an episode that was cut short, marked as such; see `finish`."""
        self.end(result or {}, reason)
        return self.store()

    def end(self, result: Mapping[str, str], reason: str | None = None) -> bool:
        """Does the first half of `finish`, or with a reason of `abort`: writes all there is.

        What a process that is killed now leaves behind is recovered whole.

        Returns:
            Whether there is something to `store`.

        Raises:
            EpisodeLogError, ValueError: As `finish` does.
        """
        outcome = {'complete': 'true'}
        if reason is not None:
            outcome = {'complete': 'false', 'reason': reason}
        return self._end({**result, **outcome})

    def discard(self) -> None:
        """Removes what there is of an episode that is not completed."""
        if self._is_open:
            self._discard()

    def store(self) -> Path | None:
        """Does the second half: waits for the disk several times, then shows the episode.

        Raises:
            EpisodeLogError: If the bag cannot be completed; the hidden directory stays.
        """
        if self._description is None:
            return self._completed
        try:
            store_bag(self._stream, self._active, self._description)
            durable.publish(self._active, self._final)
        except OSError as error:
            raise self._fail(error) from error
        self._description = None
        self._stop()
        self._completed = self._final
        return self._completed

    def _channel(self, topic: TopicSpec) -> ChannelSpec:
        channel = self._channels.get(topic.name)
        if channel is None:
            channel = self._channels[topic.name] = ChannelSpec(
                topic=topic.name if topic.name.startswith('/') else self._namespace + topic.name,
                type_name=topic.type_name,
                schema_text=schema_text(topic.type_name),
                qos=offered_qos(topic.qos),
                type_hash=type_hash(topic.type_name),
            )
        if channel.type_name != topic.type_name:
            raise ValueError(
                f'topic {topic.name} is {channel.type_name} in this episode, not {topic.type_name}'
            )
        return channel

    def _append(self, topic: TopicSpec, data: bytes, log_time_ns: int) -> bool:
        if not self._is_open:
            return False
        try:
            self._bag.write(self._channel(topic), data, log_time_ns)
        except OSError as error:
            raise self._fail(error) from error
        return True

    def _require_room(self, size: int) -> None:
        """Ends the log of an episode that no reader would take with one message more."""
        if self._is_open and not self._bag.takes(size):
            self.flush()
            raise self._fail(OSError(errno.EFBIG, _TOO_LONG))

    def _append_next(self, topic: TopicSpec, data: bytes) -> bool:
        if self._tick_ns is None:
            raise ValueError(f'{topic.name} was written before the first tick of the episode')
        time_ns = log_time(self._tick_ns, self._rank)
        self._rank += 1
        return self._append(topic, data, time_ns)

    def _flush(self, log_time_ns: int) -> None:
        try:
            self._bag.flush()
        except OSError as error:
            raise self._fail(error) from error
        self._flushed_ns = log_time_ns

    def _is_flush_due(self, log_time_ns: int) -> bool:
        if self._flushed_ns is None:
            self._flushed_ns = log_time_ns
        return log_time_ns - self._flushed_ns >= self._settings.flush_period_ns

    def _end(self, result: dict[str, str]) -> bool:
        if self._received.omitted:
            result['received_not_logged'] = json.dumps(self._received.omitted)
        record = checked_strings(result)
        if not self._is_open:
            return False
        try:
            if self._bag.info.message_count == 0:
                self._discard()
                return False
            self._is_open = False
            self._description = end_bag(self._bag, self._stream, self._metadata, record)
        except OSError as error:
            raise self._fail(error) from error
        return True

    def _fail(self, error: OSError) -> EpisodeLogError:
        self._description = None
        self._stop()
        return EpisodeLogError(f'episode log stopped, {self._stream.name}: {_reason(error)}')

    def _discard(self) -> None:
        """Removes what this writer created."""
        self._stop()
        shutil.rmtree(self._active, ignore_errors=True)

    def _stop(self) -> None:
        """Takes no more messages; the lock goes with the stream."""
        self._is_open = False
        with suppress(OSError):
            self._stream.close()
