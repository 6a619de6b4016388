"""Log the ticks of a running robot, episode by episode, without delaying the robot.

Each tick puts its messages into a queue. One thread writes them, another flushes finished files to
the disk (fsync). If the process is killed, at most the last 0.25 s of wall-clock time are lost; to
ensure this, the robot waits if the disk is slower. If the disk fails, logging stops but the robot
continues.
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from queue import Empty, Queue
from threading import Semaphore, Thread
from typing import Any

import mujoco
import numpy as np
import zstandard

from fetch_hand_sim.episode_log import (
    Attachment,
    EpisodeDirectory,
    EpisodeLogError,
    EpisodeOutcome,
    EpisodeWriter,
    episode_metadata,
)
from fetch_hand_sim.episode_log.metadata import DIVERGED
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.models import compiled_bytes
from msgs_spec.tick import EpisodeStatus, Tick
from msgs_spec.topics import TopicSpec
from node_runtime.source_revision import source_revision

Messages = Sequence[tuple[TopicSpec, bytes]]
Task = Callable[[], None]

# Seconds after which the oldest message is handed to the operating system, where simulated time
# does not lead to that: a robot that is paused, waits for commands or is slow.
_FLUSH_AFTER = 0.18
# Seconds that a message may wait for that before the robot waits for the disk.
_LONGEST_WAIT = 0.2
# Seconds without progress until the disk counts as failed, and seconds between two checks.
_STALL = 5.0
_LOOK_AFTER = 0.002
# Finished files that may wait for the disk; the operating system has them.
_MAX_UNSTORED = 16
# Seconds of waiting that are reported, and seconds between two reports.
_SLOW = 0.1
_SLOW_PERIOD = 10.0
# At the end: seconds between two calls of `gives_up`, seconds until the wait is reported, and
# seconds that a failed disk may delay the end.
_ASK_AFTER = 0.1
_PATIENCE = 3.0
_LAST_CHANCE = 5.0


class RecordingContext:
    """Creates the attachments and the metadata for the episode files of one simulation.

    Every file contains the MJCF text. `with_compiled_model` adds the compiled model, 3 MB.
    `perturb_limit` is the largest force of a push, N.
    """

    def __init__(
        self,
        simulation: Simulation,
        *,
        with_compiled_model: bool = True,
        perturb_limit: float = 0.0,
    ) -> None:
        self._simulation = simulation
        self._perturb_limit = perturb_limit
        self._model_sha256 = model_sha256(simulation.model)
        # Starts a process, which would delay a running robot.
        self._source_revision = source_revision()
        self.attachments: list[Attachment] = [mjcf_attachment(simulation.asset)]
        if with_compiled_model:
            self.attachments.append(compiled_attachment(simulation.model))
        self.checkpoint_sha256: str | None = None

    def metadata(self, status: EpisodeStatus) -> dict[str, str]:
        """Return the metadata record `episode`; `status` is the first status of the episode."""
        return episode_metadata(
            self._simulation.spec.with_joint_prefix(status.joint_prefix),
            episode=status.episode,
            seed=status.seed,
            reward_type=status.reward_type,
            success_rule=status.success_rule,
            control_hz=status.control_hz,
            timing=self._simulation.timing,
            joint_prefix=status.joint_prefix,
            model_sha256=self._model_sha256,
            source_revision=self._source_revision,
            checkpoint_sha256=self.checkpoint_sha256,
            perturb_limit=self._perturb_limit,
            disturbances=status.disturbances,
            variation=status.variation,
            started=datetime.now(UTC).isoformat(timespec='milliseconds'),
        )


@dataclass(frozen=True, slots=True)
class LoggedEpisode:
    """A logged episode: its last status and its bag; `is_complete` is False if it was cut short.

    `late_commands` counts steps without a command for the latest observation; None in lockstep.
    """

    status: EpisodeStatus
    path: Path
    is_complete: bool
    late_commands: int | None = None


class EpisodeRecorder:
    """Writes each episode of a robot to a bag of its own.

    Args:
        directory: Folder of the bags.
        namespace: Namespace of the robot, which precedes topic names in the bags.
        metadata: Returns the metadata of a new episode; called with its first status.
        on_error: Called once, with one line, when logging fails; from any thread.
        on_logged: Called for every completed file; from a thread of the recorder.
        on_slow: Called with one line, at most every 10 s, when the robot waits for the disk.
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
        self._unreported = Semaphore(1)
        self._metadata = metadata
        self._on_error = on_error
        self._on_logged = on_logged
        self._on_slow = on_slow
        self._reported_s = self._report_after = 0.0
        self._last_tick: Tick | None = None
        # Used by the writing thread alone.
        self._episodes = EpisodeDirectory(directory, namespace=namespace)
        self._attachments = attachments
        self._writer: EpisodeWriter | None = None
        # Time of the oldest message that was taken from the queue and is not flushed.
        self._unflushed_since: float | None = None
        self._tasks_done = 0
        self._tasks: Queue[tuple[float, Task] | None] = Queue()
        self._unstored: Queue[Task | None] = Queue(_MAX_UNSTORED)
        # Daemons: a disk that never answers must not delay the end of the process.
        self._threads = [
            Thread(target=self._run, args=(loop,), name=name, daemon=True)
            for loop, name in (
                (self._write_all, 'episode_log'),
                (self._store_all, 'episode_store'),
            )
        ]
        for thread in self._threads:
            thread.start()

    def record(self, tick: Tick, messages: Messages) -> None:
        """Log a tick; the reset of an episode begins a file, its last tick completes the file."""
        if tick.status.phase == 'reset':
            self._end('reset before the end')
            if not self.has_failed:
                self._put(partial(self._begin, tick.status, self._metadata(tick.status)))
                self._last_tick = tick
        if self._last_tick is None:
            return
        self._put(partial(self._write_tick, tick.stamp_ns, messages))
        self._last_tick = tick
        if tick.status.phase == 'finished':
            self._end(DIVERGED if tick.has_diverged else None)

    def record_received(self, topic: TopicSpec, data: bytes, *, is_refused: bool = False) -> None:
        """Log a received message, if an episode is running; `is_refused`: the robot rejected it."""
        if self._last_tick is not None:
            self._put(partial(self._write_received, topic, data, is_refused))

    def close(self, reason: str, gives_up: Callable[[], bool] = lambda: False) -> None:
        """Complete all files and wait until they are on the disk.

        Args:
            reason: End reason of an episode that is still running.
            gives_up: Called every 0.1 s during the wait; True ends the wait. Then
                `fetch_hand_sim episodes recover` can complete the unfinished files.
        """
        self._end(reason)
        self._tasks.put(None)
        began, is_reported = time.monotonic(), False
        for thread in self._threads:
            while thread.is_alive() and not self.has_failed:
                thread.join(_ASK_AFTER)
                if thread.is_alive() and gives_up():
                    self._fail('episode log stopped: the disk was not waited for any more')
                elif not is_reported and time.monotonic() - began > _PATIENCE:
                    is_reported = True
                    self._on_slow('waiting for the disk; another signal (Ctrl-C) gives up')
            if self.has_failed:
                thread.join(_LAST_CHANCE)

    # The robot's thread

    def _end(self, reason: str | None) -> None:
        """Complete the file of the running episode, if any; `reason` is None at its regular end."""
        tick, self._last_tick = self._last_tick, None
        if tick is not None:
            self._put(partial(self._finish, tick, reason))

    def _put(self, task: Task) -> None:
        """Queue a task for the writing thread; wait first if that thread is 0.2 s behind."""
        if self.has_failed:
            return
        began = now = progressed = time.monotonic()
        done = self._tasks_done
        while not self.has_failed and now - self._oldest(now) > _LONGEST_WAIT:
            time.sleep(_LOOK_AFTER)
            now = time.monotonic()
            if done != self._tasks_done:
                done, progressed = self._tasks_done, now
            if now - progressed > _STALL:
                self._fail(f'episode log stopped: the disk took nothing for {_STALL:g} s')
        self._tasks.put((now, task))
        if now > began:
            self.waited_s += now - began
            self._report_slow(now)

    def _oldest(self, now: float) -> float:
        """Return when the oldest message not yet passed to the OS was queued, s; if none, `now`."""
        since = self._unflushed_since
        if since is not None:
            return since
        try:
            head = self._tasks.queue[0]
        except IndexError:
            return now
        return now if head is None else head[0]

    def _report_slow(self, now: float) -> None:
        if self.waited_s - self._reported_s > _SLOW and now >= self._report_after:
            self._reported_s = self.waited_s
            self._report_after = now + _SLOW_PERIOD
            self._on_slow(
                f'the disk is slower than the robot, which waits for it: {self.waited_s:.1f} s '
                'so far'
            )

    # Any thread

    def _fail(self, line: str) -> None:
        self.has_failed = True
        self._last_tick = None
        if self._unreported.acquire(blocking=False):
            self._on_error(line)

    def _run(self, loop: Task) -> None:
        try:
            loop()
        except BaseException:
            self._fail('episode log stopped: an error in the program')
            raise

    # The writing thread

    def _write_all(self) -> None:
        """Run the queued tasks until the recorder is closed."""
        try:
            while self._run_next():
                pass
        finally:
            self._unstored.put(None)

    def _run_next(self) -> bool:
        """Run the next task, or pass messages to the OS if due; return False when closed."""
        task: Task | None = self._flush
        try:
            entry = self._tasks.get(timeout=self._time_to_flush())
        except Empty:
            pass
        else:
            since, task = entry or (None, None)
            if self._unflushed_since is None:
                self._unflushed_since = since
        if task is not None and not self.has_failed:
            try:
                task()
            except EpisodeLogError as error:
                self._fail(str(error))
        self._tasks_done += 1
        if self.has_failed or self._writer is None or not self._writer.has_unflushed:
            self._unflushed_since = None
        return task is not None

    def _time_to_flush(self) -> float | None:
        if self._unflushed_since is None:
            return None
        return max(0.0, self._unflushed_since + _FLUSH_AFTER - time.monotonic())

    def _flush(self) -> None:
        if self._writer is not None:
            self._writer.flush()

    def _begin(self, status: EpisodeStatus, metadata: Mapping[str, str]) -> None:
        self._writer = self._episodes.begin(status.task, status.seed, metadata, self._attachments)

    def _write_tick(self, stamp_ns: int, messages: Messages) -> None:
        if self._writer is not None:
            self._writer.write_tick(stamp_ns, messages)

    def _write_received(self, topic: TopicSpec, data: bytes, is_refused: bool) -> None:
        if self._writer is not None:
            self._writer.write_received(topic, data, is_refused=is_refused)

    def _finish(self, tick: Tick, reason: str | None) -> None:
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.end(episode_result(tick.status, tick.late_commands), reason)
            self._unstored.put(partial(self._store, writer, tick, reason is None))

    # The storing thread

    def _store_all(self) -> None:
        """Flush finished files to the disk (fsync) until the recorder is closed."""
        while (store := self._unstored.get()) is not None:
            store()

    def _store(self, writer: EpisodeWriter, tick: Tick, is_complete: bool) -> None:
        try:
            path = writer.store()
        except EpisodeLogError as error:
            self._fail(str(error))
        else:
            if path is not None:
                self._on_logged(LoggedEpisode(tick.status, path, is_complete, tick.late_commands))


def episode_result(status: EpisodeStatus, late_commands: int | None = None) -> dict[str, str]:
    """Return the metadata record `episode_result`; `status` is the last status of the episode.

    `late_commands` counts steps without a command for the latest observation; None in lockstep.
    """
    return EpisodeOutcome(
        steps=status.tick,
        episode_return=status.episode_return,
        is_success=status.is_success,
        late_commands=late_commands,
    ).to_strings()


# The model in an episode
#
# Every episode contains the MJCF text, 15 to 34 KB, and the SHA-256 of the compiled model, which
# has 7 to 13 MB (3.0 to 3.4 MB with zstd), mostly meshes. MuJoCo writes MJCF with about seven
# digits. For every bit, compile the model with the versions in the metadata, or store it.

# Fields of a compiled model that depend on the place of its files, and fields that no file keeps.
_OF_PATHS = {'paths', 'npaths', 'hfield_pathadr', 'mesh_pathadr', 'skin_pathadr', 'tex_pathadr'}
_LEFT_OUT = frozenset({*_OF_PATHS, 'nbuffer', 'signature'})


def model_sha256(model: mujoco.MjModel) -> str:
    """Return a hash of a compiled model; equal models on one MuJoCo version have the same hash.

    It does not depend on the paths of mesh and texture files, which differ between machines.
    """
    digest = hashlib.sha256()
    for name, content in _contents(model):
        digest.update(f'{name} {len(content)} '.encode())
        digest.update(content)
    return digest.hexdigest()


def former_model_sha256(model: mujoco.MjModel) -> str:
    """Return the model hash of logs up to version 1.0, which depends on file paths."""
    return hashlib.sha256(compiled_bytes(model)).hexdigest()


def _contents(struct: Any, prefix: str = '') -> Iterator[tuple[str, bytes]]:
    """Yield name and bytes of each field of a MuJoCo structure and nested ones, except paths."""
    for name in dir(struct):
        if name.startswith('_') or name in _LEFT_OUT:
            continue
        value = getattr(struct, name)
        if isinstance(value, np.ndarray):
            yield prefix + name, value.tobytes()
        elif isinstance(value, bytes | int | float):
            yield prefix + name, repr(value).encode()
        elif not callable(value):
            yield from _contents(value, f'{prefix}{name}.')


def mjcf_attachment(path: Path) -> Attachment:
    """Return the MJCF file at `path` and the files it includes as one text, without meshes."""
    text = mujoco.MjSpec.from_file(str(path)).to_xml()
    return Attachment('model.xml', 'application/xml', text.encode())


def compiled_attachment(model: mujoco.MjModel) -> Attachment:
    """Return the compiled model, compressed with zstd to 3 MB; slow, so reuse the result."""
    data = zstandard.ZstdCompressor(level=10).compress(compiled_bytes(model))
    return Attachment('model.mjb.zst', 'application/zstd', data)
