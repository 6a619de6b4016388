"""Logs the ticks of a running robot, episode by episode, without holding the robot up.

The messages of a tick are written as they come, microseconds each. Completing a file waits for the
disk, so that is done by a worker thread while the next episode runs. A disk that fails stops
logging, never the robot.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from fetch_hand_sim.episode_log import Attachment, EpisodeDirectory, EpisodeLogError, EpisodeWriter
from msgs_spec.tick import EpisodeStatus, Tick
from msgs_spec.topics import TopicSpec

Messages = Sequence[tuple[TopicSpec, bytes]]


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
            metadata: Makes the metadata of an episode from the status of its first tick.
            on_error: Called once, with one line, when the disk fails; may be called by the worker
            thread.
            on_logged: Called for every completed file, likewise.
        """
        self._episodes = EpisodeDirectory(directory, namespace=namespace)
        self._attachments = attachments
        self._metadata = metadata
        self._on_error = on_error
        self._on_logged = on_logged
        self._worker = ThreadPoolExecutor(max_workers=1, thread_name_prefix='episode_log')
        self._writer: EpisodeWriter | None = None
        self._status: EpisodeStatus | None = None
        self.has_failed = False

    def record(self, tick: Tick, messages: Messages) -> None:
        """Writes a tick: a reset begins a file, a finished episode completes it."""
        status = tick.status
        if status.phase == 'reset':
            self.interrupt('reset before the end')
            self._begin(status)
        self._status = status
        self._guarded(lambda writer: writer.write_tick(tick.stamp_ns, messages))
        if status.phase == 'finished':
            self._complete(lambda writer, result: writer.finish(result), is_complete=True)

    def record_received(self, topic: TopicSpec, data: bytes) -> None:
        """Writes a message received since the last tick; between episodes there is no file."""
        self._guarded(lambda writer: writer.write_received(topic, data))

    def interrupt(self, reason: str) -> None:
        """Completes the running episode, if there is one, marked as cut short."""
        self._complete(lambda writer, result: writer.abort(reason, result), is_complete=False)

    def close(self, reason: str) -> None:
        """Completes everything, also what is still being completed."""
        self.interrupt(reason)
        self._worker.shutdown(wait=True)

    def _begin(self, status: EpisodeStatus) -> None:
        if self.has_failed:
            return
        try:
            self._writer = self._episodes.begin(
                status.task, status.seed, self._metadata(status), self._attachments
            )
        except EpisodeLogError as error:
            self._fail(error)

    def _guarded(self, write: Callable[[EpisodeWriter], object]) -> None:
        if self._writer is None:
            return
        try:
            write(self._writer)
        except EpisodeLogError as error:
            self._fail(error)

    def _complete(
        self,
        complete: Callable[[EpisodeWriter, Mapping[str, str]], Path | None],
        *,
        is_complete: bool,
    ) -> None:
        writer, status, self._writer = self._writer, self._status, None
        if writer is None or status is None:
            return

        def work() -> None:
            try:
                path = complete(writer, episode_result(status))
            except EpisodeLogError as error:
                self._fail(error)
            else:
                if path is not None:
                    self._on_logged(LoggedEpisode(status, path, is_complete))

        self._worker.submit(work)

    def _fail(self, error: EpisodeLogError) -> None:
        self._writer = None
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
