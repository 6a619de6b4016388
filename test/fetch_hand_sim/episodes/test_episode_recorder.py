"""The recorder of a running robot: the worker's part delays no tick and changes no byte."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from mcap.exceptions import EndOfFile
from mcap.records import Chunk
from mcap.stream_reader import StreamReader

from fetch_hand_sim.episode_log import (
    EpisodeDirectory,
    EpisodeLogError,
    EpisodeWriter,
    read_episode,
)
from fetch_hand_sim.episodes import recorder as recorder_module
from fetch_hand_sim.episodes.recorder import EpisodeRecorder, Messages, episode_result
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec
from msgs_spec.tasks import TASKS
from msgs_spec.tick import Tick
from msgs_spec.topics import TopicSpec, topic
from support import wait_until
from support.episode_recorder import rested_episode

METADATA = {'task': 'FetchReach'}
COMMANDS = topic(TASKS['FetchReach'], 'commands')
COMMAND = TopicCodec(COMMANDS).encode(0, np.zeros(COMMANDS.size))

Ticks = list[tuple[Tick, list[tuple[TopicSpec, bytes]]]]


@pytest.fixture(scope='module')
def ticks() -> Ticks:
    """One episode."""
    return list(rested_episode(EpisodeRunner(Simulation('FetchReach', num_threads=1))))


def recorder_into(
    directory: Path,
    on_error: Callable[[str], object],
    on_slow: Callable[[str], None] = lambda line: None,
    metadata: Mapping[str, str] = METADATA,
) -> EpisodeRecorder:
    """A recorder as a robot has it."""
    return EpisodeRecorder(
        directory,
        metadata=lambda status: dict(metadata),
        on_error=on_error,
        on_logged=lambda episode: None,
        on_slow=on_slow,
    )


def record(
    directory: Path,
    ticks: Ticks,
    pause: float = 0.0,
    on_slow: Callable[[str], None] = lambda line: None,
) -> tuple[list[str], float]:
    """Logs an episode as a robot does; returns what it complained of and its longest tick."""
    errors: list[str] = []
    recorder = recorder_into(directory, errors.append, on_slow)
    longest = 0.0
    for tick, messages in ticks:
        began = time.perf_counter()
        recorder.record(tick, messages)
        recorder.record_received(COMMANDS, COMMAND)
        longest = max(longest, time.perf_counter() - began)
        time.sleep(pause)
    recorder.close('end')
    return errors, longest


def write(directory: Path, ticks: Ticks) -> None:
    """Logs the same episode with the writer alone."""
    status = ticks[0][0].status
    writer = EpisodeDirectory(directory).begin(status.task, status.seed, METADATA, ())
    for tick, messages in ticks:
        writer.write_tick(tick.stamp_ns, messages)
        # After the last tick the episode is over: the recorder takes nothing more.
        if tick.status.phase != 'finished':
            writer.write_received(COMMANDS, COMMAND)
    writer.finish(episode_result(ticks[-1][0].status))


def files(directory: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in directory.glob('*/*')}


@pytest.mark.parametrize('pause', [0.0, 0.002])
def test_the_file_is_the_one_a_writer_alone_makes(
    tmp_path: Path, ticks: Ticks, pause: float
) -> None:
    assert record(tmp_path / 'recorder', ticks, pause)[0] == []
    write(tmp_path / 'writer', ticks)
    made = files(tmp_path / 'recorder')
    assert len(made) == 2 and made == files(tmp_path / 'writer')


def test_metadata_are_those_of_the_moment_in_which_an_episode_begins(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """However far the disk is behind: who introduces himself later has not begun it."""
    opened = threading.Event()
    begin = EpisodeDirectory.begin

    def late(*arguments: object) -> object:
        opened.wait(10.0)
        return begin(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(EpisodeDirectory, 'begin', late)
    metadata = dict(METADATA)
    recorder = recorder_into(tmp_path, pytest.fail, metadata=metadata)
    recorder.record(*ticks[0])
    metadata['checkpoint_sha256'] = 'f' * 64
    opened.set()
    for tick, messages in ticks[1:]:
        recorder.record(tick, messages)
    recorder.close('')
    (file,) = tmp_path.glob('*/*.mcap')
    assert 'checkpoint_sha256' not in read_episode(file).metadata


@pytest.mark.alone
def test_a_slow_disk_delays_no_tick(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The end of a file waits for the disk, and the ticks do not wait for that."""
    store = EpisodeWriter.store

    def wait(writer: EpisodeWriter) -> Path | None:
        time.sleep(0.5)
        return store(writer)

    monkeypatch.setattr(EpisodeWriter, 'store', wait)
    errors, longest = record(tmp_path / 'recorder', [*ticks, *ticks], pause=0.002)
    assert errors == [] and longest < 0.15
    assert len(list((tmp_path / 'recorder').iterdir())) == 2


@pytest.mark.alone
def test_a_robot_faster_than_its_disk_waits_and_reports_it(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_tick, slow = EpisodeWriter.write_tick, []

    def wait(writer: EpisodeWriter, stamp_ns: int, messages: Messages) -> bool:
        time.sleep(0.02)
        return write_tick(writer, stamp_ns, messages)

    monkeypatch.setattr(EpisodeWriter, 'write_tick', wait)
    began = time.monotonic()
    errors, longest = record(tmp_path / 'recorder', ticks, pause=0.005, on_slow=slow.append)
    assert errors == [] and time.monotonic() - began > 51 * 0.02
    assert longest > 0.01, 'no tick waited'
    (line,) = slow
    assert 'the disk is slower than the robot, which waits for it' in line
    monkeypatch.undo()
    write(tmp_path / 'writer', ticks)
    assert read(tmp_path / 'recorder') == read(tmp_path / 'writer')


def read(directory: Path) -> dict[str, object]:
    (path,) = directory.iterdir()
    return dict(read_episode(path).topics)


def test_a_stuck_disk_stops_the_log(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck = threading.Event()
    monkeypatch.setattr(EpisodeWriter, 'write_tick', lambda *_: stuck.wait(20.0))
    monkeypatch.setattr(recorder_module, '_STALL', 0.3)
    monkeypatch.setattr(recorder_module, '_LAST_CHANCE', 0.1)
    errors, longest = record(tmp_path / 'recorder', ticks, pause=0.01)
    stuck.set()
    assert errors == ['episode log stopped: the disk took nothing for 0.3 s']
    assert longest < 2.0


def test_closing_waits_for_a_stuck_disk_until_the_user_gives_up(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, errors, slow = threading.Event(), [], []
    monkeypatch.setattr(EpisodeWriter, 'store', lambda *_: stuck.wait(20.0) and None)
    monkeypatch.setattr(recorder_module, '_PATIENCE', 0.3)
    monkeypatch.setattr(recorder_module, '_LAST_CHANCE', 0.1)
    recorder = recorder_into(tmp_path / 'recorder', errors.append, slow.append)
    for tick, messages in ticks:
        recorder.record(tick, messages)
    began = time.monotonic()
    recorder.close('end', lambda: bool(slow) and time.monotonic() - began > 0.6)
    assert 0.6 < time.monotonic() - began < 5.0
    stuck.set()
    assert slow == ['waiting for the disk; another signal (Ctrl-C) gives up']
    assert errors == ['episode log stopped: the disk was not waited for any more']
    assert recorder.has_failed


def test_messages_of_a_paused_robot_are_flushed_without_a_tick(
    tmp_path: Path, ticks: Ticks
) -> None:
    recorder = recorder_into(tmp_path, pytest.fail)
    recorder.record(*ticks[0])
    for _ in range(3):
        recorder.record_received(COMMANDS, COMMAND)
    wait_until(lambda: any(map(chunks, tmp_path.glob('.*/*.mcap'))), 'whole chunk')
    recorder.close('end')
    (path,) = tmp_path.iterdir()
    assert len(read_episode(path).topics['/commands'].messages) == 3


def chunks(path: Path) -> list[Chunk]:
    """The whole chunks of a file in progress."""
    found: list[Chunk] = []
    with path.open('rb') as stream, suppress(EndOfFile):
        found.extend(
            r for r in StreamReader(stream, emit_chunks=True).records if isinstance(r, Chunk)
        )
    return found


@pytest.mark.parametrize('step', ['write_tick', 'store'])
def test_a_disk_error_in_either_thread_is_reported_once_and_leaves_no_work(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    """Tasks that are queued after the failure are neither run nor waited for."""

    def fail(*_: object) -> None:
        raise EpisodeLogError('episode log stopped: disk full')

    monkeypatch.setattr(EpisodeWriter, step, fail)
    errors: list[str] = []
    recorder = recorder_into(tmp_path, errors.append)
    for tick in (*ticks, ticks[0]):
        recorder.record(*tick)
    wait_until(lambda: errors, 'error')
    recorder._tasks.put((time.monotonic(), lambda: None))
    began = time.process_time()
    time.sleep(0.5)
    assert time.process_time() - began < 0.25
    recorder.close('end')
    assert errors == ['episode log stopped: disk full']
    assert not [path for path in tmp_path.iterdir() if path.name[0] != '.']


def test_closing_after_a_disk_error_waits_no_longer_than_the_limit(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, gone_on, stored = (threading.Event() for _ in range(3))
    store = EpisodeWriter.store

    def late(writer: EpisodeWriter) -> Path | None:
        begun.set()
        gone_on.wait(20.0)
        path = store(writer)
        stored.set()
        return path

    monkeypatch.setattr(EpisodeWriter, 'store', late)
    monkeypatch.setattr(recorder_module, '_LAST_CHANCE', 0.1)
    recorder = recorder_into(tmp_path, lambda line: None)
    for tick in ticks:
        recorder.record(*tick)
    assert begun.wait(10.0)
    recorder._fail('episode log stopped: as another file says')
    began = time.monotonic()
    recorder.close('end')
    assert time.monotonic() - began < 2.0
    gone_on.set()
    assert stored.wait(10.0)
