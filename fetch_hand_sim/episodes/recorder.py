"""Logs the ticks of a running robot, episode by episode, without holding the robot up.

A tick puts its messages into a queue; one thread writes them, and another waits for the disk where
a finished file has to. A killed robot loses what the operating system had not got yet. That is a
quarter of a second of wall time at most, however fast the robot runs: one that is faster than its
disk waits. A disk that fails stops logging, never the robot.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import Queue
from threading import Semaphore, Thread

from fetch_hand_sim.episode_log import (
    Attachment,
    EpisodeDirectory,
    EpisodeLogError,
    EpisodeOutcome,
    EpisodeWriter,
)
from fetch_hand_sim.episodes.backlog import Backlog, StalledError
from msgs_spec.tick import EpisodeStatus, Tick
from msgs_spec.topics import TopicSpec

Messages = Sequence[tuple[TopicSpec, bytes]]

# Seconds after which the oldest message is handed to the operating system, where simulated time
# does not lead to that: a robot that is paused, waits for commands or is slow.
_FLUSH_AFTER = 0.18
# Files that may wait for the disk to have them for good; the operating system has them.
_MAX_UNSTORED = 16
# Seconds of waiting that are worth a line, and seconds between two lines.
_SLOW = 0.1
_SLOW_PERIOD = 10.0
# Seconds between two looks at whether anybody still waits for the disk at the end, and seconds
# after which it is said that this is what is waited for.
_LOOK_AFTER = 0.1
_PATIENCE = 3.0
# Seconds that a disk which has failed may still hold up the end.
_LAST_CHANCE = 5.0
# Why an episode was cut short that MuJoCo gave up.
DIVERGED = 'diverged'


@dataclass(frozen=True, slots=True)
class LoggedEpisode:
    """A completed file.

    Attributes:
        status: Of the last tick.
        path: The bag directory.
        is_complete: Whether the episode ran to its end.
    """

    status: EpisodeStatus
    path: Path
    is_complete: bool


class EpisodeRecorder:
    """Writes each episode of a robot to a bag of its own.

    Args:
        directory: Where episodes are collected.
        namespace: ROS namespace of relative topic names.
        attachments: Files stored with every episode.
        metadata: Makes the metadata of an episode from the status of its first tick, when it is
            recorded.
        on_error: Called once, with one line, when the disk fails, by any thread.
        on_logged: Called for every completed file, by a thread of its own.
        on_slow: Called with one line when the robot has to wait for the disk, now and then.

    Attributes:
        has_failed: Whether the disk failed, so that nothing more is logged.
        waited_s: Seconds the robot has waited for the disk.
    """

    def __init__(
        self,
        directory: Path,
        *,
        namespace: str = '/',
        attachments: Sequence[Attachment] = (),
        metadata: Callable[[EpisodeStatus], Mapping[str, str]],
        on_error: Callable[[str], None],
        on_logged: Callable[[LoggedEpisode], None],
        on_slow: Callable[[str], None] = lambda line: None,
    ) -> None:
        self.has_failed = False
        self.waited_s = 0.0
        self._untold = Semaphore(1)
        self._metadata = metadata
        self._on_error = on_error
        self._on_slow = on_slow
        self._waited_said_s = self._say_after = 0.0
        self._status: EpisodeStatus | None = None
        # What the writing thread is to do, in order.
        self._backlog: Backlog[Callable[[], None]] = Backlog()
        self._files = _EpisodeFiles(
            EpisodeDirectory(directory, namespace=namespace),
            attachments,
            self._fail,
            on_logged,
        )
        self._thread = Thread(target=self._write, name='episode_log', daemon=True)
        self._thread.start()

    def record(self, tick: Tick, messages: Messages) -> None:
        """Logs a tick: a reset begins a file, a finished episode completes it."""
        if tick.status.phase == 'reset':
            self._end('reset before the end')
            if not self.has_failed:
                metadata = self._metadata(tick.status)
                self._put(partial(self._files.begin, tick.status, metadata))
                self._status = tick.status
        if self._status is None:
            return
        self._put(partial(self._files.write_tick, tick.stamp_ns, messages))
        self._status = tick.status
        if tick.status.phase == 'finished':
            self._end(DIVERGED if tick.has_diverged else None)

    def record_received(self, topic: TopicSpec, data: bytes, *, is_refused: bool = False) -> None:
        """Logs a message received since the last tick; between episodes there is no file."""
        if self._status is not None:
            self._put(partial(self._files.write_received, topic, data, is_refused))

    def close(self, reason: str, gives_up: Callable[[], bool] = lambda: False) -> None:
        """Completes everything, also what is still being completed.

        Args:
            reason: What cuts the running episode short, if there is one.
            gives_up: Asked now and then while the disk takes its time: whether to leave what it
                has not taken, which `fetch_hand_sim episodes recover` completes.
        """
        self._end(reason)
        self._backlog.close()
        began = time.monotonic()
        self._await(self._thread, gives_up, began)
        self._files.finish()
        self._await(self._files.storing, gives_up, began)

    def _await(self, thread: Thread, gives_up: Callable[[], bool], began: float) -> None:
        """Waits for the end of a thread that a disk may hold up, also for ever."""
        has_said = False
        while thread.is_alive() and not self.has_failed:
            thread.join(_LOOK_AFTER)
            if thread.is_alive() and gives_up():
                self._fail('episode log stopped: the disk was not waited for any more')
            elif not has_said and time.monotonic() - began > _PATIENCE:
                has_said = True
                self._on_slow('waiting for the disk; another signal (Ctrl-C) gives up')
        if self.has_failed:
            thread.join(_LAST_CHANCE)

    def _end(self, reason: str | None) -> None:
        """Completes the running episode, if there is one; with a reason, marked as cut short."""
        status, self._status = self._status, None
        if status is not None:
            self._put(partial(self._files.end, status, reason))

    def _put(self, write: Callable[[], None]) -> None:
        """Queues what is to be written; a robot that is faster than its disk waits here."""
        if self.has_failed:
            return
        try:
            waited = self._backlog.put(write)
        except StalledError as error:
            self._fail(f'episode log stopped: {error}')
            return
        if waited > 0.0:
            self.waited_s += waited
            self._say_slow(time.monotonic())

    def _say_slow(self, now: float) -> None:
        if self.waited_s - self._waited_said_s > _SLOW and now >= self._say_after:
            self._waited_said_s = self.waited_s
            self._say_after = now + _SLOW_PERIOD
            self._on_slow(
                f'the disk is slower than the robot, which waits for it: {self.waited_s:.1f} s '
                'so far'
            )

    def _fail(self, line: str) -> None:
        # First of all: what is put into the backlog after it was cleared is not waited for.
        self.has_failed = True
        self._status = None
        self._backlog.clear()
        if self._untold.acquire(blocking=False):
            self._on_error(line)

    def _write(self) -> None:
        """Writes what is queued until the recorder is closed; runs in a thread of its own."""
        try:
            while not self._backlog.is_done:
                write = self._backlog.take(_FLUSH_AFTER) or self._files.flush
                if not self.has_failed:
                    self._try(write)
                if self.has_failed or not self._files.has_unflushed:
                    self._backlog.note_saved()
        except BaseException:
            self._fail('episode log stopped: an error in the program')
            raise

    def _try(self, write: Callable[[], None]) -> None:
        try:
            write()
        except EpisodeLogError as error:
            self._fail(str(error))


class _EpisodeFiles:
    """The file in progress, and those that wait for the disk; used by one thread.

    Methods that write raise `EpisodeLogError` at the first error of the disk.
    """

    def __init__(
        self,
        episodes: EpisodeDirectory,
        attachments: Sequence[Attachment],
        on_error: Callable[[str], None],
        on_logged: Callable[[LoggedEpisode], None],
    ) -> None:
        self._episodes = episodes
        self._attachments = attachments
        self._on_error = on_error
        self._on_logged = on_logged
        self._writer: EpisodeWriter | None = None
        # A thread that a disk holds up for ever must not hold up the end of the process.
        self._unstored: Queue[Callable[[], None] | None] = Queue()
        self._room = Semaphore(_MAX_UNSTORED)
        self.storing = Thread(target=self._store_all, name='episode_store', daemon=True)
        self.storing.start()

    @property
    def has_unflushed(self) -> bool:
        """Whether something was written that the operating system does not have yet."""
        return self._writer is not None and self._writer.has_unflushed

    def flush(self) -> None:
        """Hands what was written to the operating system."""
        if self._writer is not None:
            self._writer.flush()

    def begin(self, status: EpisodeStatus, metadata: Mapping[str, str]) -> None:
        """Begins the file of an episode with this first status."""
        self._room.acquire()
        self._writer = self._episodes.begin(status.task, status.seed, metadata, self._attachments)

    def write_tick(self, stamp_ns: int, messages: Messages) -> None:
        """Writes the messages of a tick."""
        if self._writer is not None:
            self._writer.write_tick(stamp_ns, messages)

    def write_received(self, topic: TopicSpec, data: bytes, is_refused: bool) -> None:
        """Writes a message that the robot received."""
        if self._writer is not None:
            self._writer.write_received(topic, data, is_refused=is_refused)

    def end(self, status: EpisodeStatus, reason: str | None) -> None:
        """Ends the file of an episode with this last status; a reason if it was cut short."""
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.end(episode_result(status), reason)
            self._unstored.put(partial(self._store, writer, status, reason is None))

    def finish(self) -> None:
        """Nothing more comes: `storing` ends once all files are on the disk."""
        self._unstored.put(None)

    def _store_all(self) -> None:
        """Stores files until there are no more; runs in a thread of its own."""
        try:
            while (store := self._unstored.get()) is not None:
                store()
        except BaseException:
            self._on_error('episode log stopped: an error in the program')
            raise

    def _store(self, writer: EpisodeWriter, status: EpisodeStatus, is_complete: bool) -> None:
        try:
            path = writer.store()
        except EpisodeLogError as error:
            self._on_error(str(error))
        else:
            if path is not None:
                self._on_logged(LoggedEpisode(status, path, is_complete))
        finally:
            self._room.release()


def episode_result(status: EpisodeStatus) -> dict[str, str]:
    """What the metadata record `episode_result` says of an episode, from its last status."""
    return EpisodeOutcome(
        steps=status.tick,
        episode_return=status.episode_return,
        is_success=status.is_success,
    ).to_strings()
