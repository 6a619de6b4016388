"""Logs the ticks of a running robot, episode by episode, without holding the robot up.

The messages of a tick are written as they come, microseconds each. Beginning a file takes
milliseconds, compressing a quarter of a second a third of one, and completing a file waits for the
disk: a worker thread does these. A disk that fails stops logging, never the robot.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from threading import Semaphore
from typing import Any

from fetch_hand_sim.episode_log import Attachment, EpisodeDirectory, EpisodeLogError, EpisodeWriter
from fetch_hand_sim.episode_log.log_times import log_time
from msgs_spec.tick import EpisodeStatus, Tick
from msgs_spec.topics import TopicSpec

Messages = Sequence[tuple[TopicSpec, bytes]]

# Writes of a backlog at a time: those of a tick and as many again.
_MOST_AT_ONCE = 4
# Files that may wait for the disk, minutes of a robot in real time.
_MAX_UNFINISHED = 64
# Seconds after which a disk with so many files waiting counts as dead.
_LONGEST_STALL = 1.0


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


class _EpisodeInProgress:
    """An episode whose file is written here, except while the worker opens or flushes it."""

    def __init__(self, worker: Executor, begin: Callable[[], EpisodeWriter]) -> None:
        self.status: EpisodeStatus | None = None
        self._worker = worker
        self._opening = worker.submit(begin)
        self._busy: Future[Any] = self._opening
        self._waiting: deque[Callable[[EpisodeWriter], object]] = deque()

    def write_tick(self, stamp_ns: int, messages: Messages) -> None:
        """Writes a tick; see `write`."""
        if self._busy.done() and not self._waiting:
            self._busy.result()
            writer, first_ns = self._opening.result(), log_time(stamp_ns, 0)
            if writer.flush_is_due(first_ns):
                self._busy = self._worker.submit(writer.flush, first_ns)
        self.write(lambda writer: writer.write_tick(stamp_ns, messages))

    def write(self, write: Callable[[EpisodeWriter], object]) -> None:
        """Writes now if the file is free, else later; a backlog is worked off over some ticks.

        Raises:
            EpisodeLogError: If it could not be opened, or at the first error of the disk.
        """
        self._waiting.append(write)
        if self._busy.done():
            self._write_waiting(_MOST_AT_ONCE)

    def caught_up(self) -> EpisodeWriter:
        """Waits for the file, writes what waited for it and returns it; likewise."""
        self._write_waiting(len(self._waiting))
        return self._opening.result()

    def _write_waiting(self, count: int) -> None:
        self._busy.result()
        writer = self._opening.result()
        for _ in range(min(count, len(self._waiting))):
            self._waiting.popleft()(writer)


class EpisodeRecorder:
    """Writes each episode of a robot to a bag of its own."""

    def __init__(
        self,
        directory: Path,
        *,
        namespace: str = '/',
        attachments: Sequence[Attachment] = (),
        metadata: Callable[[EpisodeStatus], Mapping[str, str]],
        on_error: Callable[[str], None],
        on_logged: Callable[[LoggedEpisode], None],
    ) -> None:
        """Prepares logging; the first episode begins with the first reset tick.

        Args:
            directory: Where episodes are collected.
            namespace: ROS namespace of relative topic names.
            attachments: Files stored with every episode.
            metadata: Makes the metadata of an episode from the status of its first tick; called by
                the worker.
            on_error: Called once, with one line, when the disk fails; may be called by the worker.
            on_logged: Called by the worker for every completed file.
        """
        self._episodes = EpisodeDirectory(directory, namespace=namespace)
        self._attachments = attachments
        self._metadata = metadata
        self._on_error = on_error
        self._on_logged = on_logged
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix='episode_log')
        self._room = Semaphore(_MAX_UNFINISHED)
        self._current: _EpisodeInProgress | None = None
        self.has_failed = False

    def record(self, tick: Tick, messages: Messages) -> None:
        """Writes a tick: a reset begins a file, a finished episode completes it."""
        if tick.status.phase == 'reset':
            self.interrupt('reset before the end')
            self._begin(tick.status)
        if self._current is not None:
            self._current.status = tick.status
        self._write(lambda episode: episode.write_tick(tick.stamp_ns, messages))
        if tick.status.phase == 'finished':
            self._complete(lambda writer, result: writer.finish(result), is_complete=True)

    def record_received(self, topic: TopicSpec, data: bytes) -> None:
        """Writes a message received since the last tick; between episodes there is no file."""
        self._write(
            lambda episode: episode.write(lambda writer: writer.write_received(topic, data))
        )

    def interrupt(self, reason: str) -> None:
        """Completes the running episode, if there is one, marked as cut short."""
        self._complete(lambda writer, result: writer.abort(reason, result), is_complete=False)

    def close(self, reason: str) -> None:
        """Completes everything, also what is still being completed."""
        self.interrupt(reason)
        self._worker.shutdown(wait=True)

    def _begin(self, status: EpisodeStatus) -> None:
        """Lets the worker open the file of an episode.

        A robot that runs as fast as possible can outrun a disk, and goes as fast as the disk then.
        """
        if self.has_failed:
            return
        if not self._room.acquire(timeout=_LONGEST_STALL):
            self._fail(EpisodeLogError(f'episode log stopped: {_MAX_UNFINISHED} files wait'))
            return
        self._current = _EpisodeInProgress(
            self._worker,
            lambda: self._episodes.begin(
                status.task, status.seed, self._metadata(status), self._attachments
            ),
        )

    def _write(self, write: Callable[[_EpisodeInProgress], None]) -> None:
        if self._current is None:
            return
        try:
            write(self._current)
        except EpisodeLogError as error:
            self._fail(error)

    def _complete(
        self,
        complete: Callable[[EpisodeWriter, Mapping[str, str]], Path | None],
        *,
        is_complete: bool,
    ) -> None:
        episode, self._current = self._current, None
        if episode is None or episode.status is None:
            return
        status = episode.status

        def work() -> None:
            try:
                path = complete(episode.caught_up(), episode_result(status))
            except EpisodeLogError as error:
                self._fail(error)
            else:
                if path is not None:
                    self._on_logged(LoggedEpisode(status, path, is_complete))
            finally:
                self._room.release()

        self._worker.submit(work)

    def _fail(self, error: EpisodeLogError) -> None:
        self._current = None
        if not self.has_failed:
            self.has_failed = True
            self._on_error(str(error))


def episode_result(status: EpisodeStatus) -> dict[str, str]:
    """What the metadata record `episode_result` says of an episode, from its last status."""
    return {
        'steps': str(status.tick),
        'return': repr(status.episode_return),
        'success': str(status.is_success).lower(),
    }
