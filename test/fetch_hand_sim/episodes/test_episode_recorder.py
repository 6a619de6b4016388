"""The recorder of a running robot: the worker's part delays no tick and changes no byte."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory, EpisodeLogError, EpisodeWriter
from fetch_hand_sim.episodes.recorder import EpisodeRecorder, episode_result
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.cdr import TopicCodec
from msgs_spec.tasks import TASKS
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import TopicSpec, topic

METADATA = {'task': 'FetchReach'}
COMMANDS = topic(TASKS['FetchReach'], 'commands')
COMMAND = TopicCodec(COMMANDS).encode(0, np.zeros(COMMANDS.size))

Ticks = list[tuple[Tick, list[tuple[TopicSpec, bytes]]]]


@pytest.fixture(scope='module')
def ticks() -> Ticks:
    """One episode."""
    simulation = Simulation('FetchReach', num_threads=1)
    runner, encoder = EpisodeRunner(simulation), TickEncoder(simulation.spec)
    recorded: Ticks = []
    while not recorded or not runner.is_between_episodes:
        tick = runner.advance(runner.resting_command())
        recorded.append((tick, encoder.encode(tick, latched=tick.status.phase != 'running')))
    return recorded


def record(directory: Path, ticks: Ticks, pause: float = 0.0) -> tuple[list[str], float]:
    """Logs an episode as a robot does; returns what it complained of and its longest tick."""
    errors: list[str] = []
    recorder = EpisodeRecorder(
        directory,
        metadata=lambda status: METADATA,
        on_error=errors.append,
        on_logged=lambda episode: None,
    )
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


def slowed(
    flush: Callable[[EpisodeWriter, int], None], seconds: float
) -> Callable[[EpisodeWriter, int], None]:
    def wait(writer: EpisodeWriter, log_time_ns: int) -> None:
        time.sleep(seconds)
        flush(writer, log_time_ns)

    return wait


@pytest.mark.parametrize('pause', [0.0, 0.002])
def test_the_file_is_the_one_a_writer_alone_makes(
    tmp_path: Path, ticks: Ticks, pause: float
) -> None:
    assert record(tmp_path / 'recorder', ticks, pause)[0] == []
    write(tmp_path / 'writer', ticks)
    made = files(tmp_path / 'recorder')
    assert len(made) == 2 and made == files(tmp_path / 'writer')


def test_a_slow_disk_delays_no_tick(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path / 'writer', ticks)
    monkeypatch.setattr(EpisodeWriter, 'flush', slowed(EpisodeWriter.flush, 0.2))
    errors, longest = record(tmp_path / 'recorder', ticks, pause=0.01)
    assert errors == [] and longest < 0.15
    assert files(tmp_path / 'recorder') == files(tmp_path / 'writer')


def test_a_disk_that_fails_behind_the_robots_back_is_said_once(
    tmp_path: Path, ticks: Ticks, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(writer: EpisodeWriter, log_time_ns: int) -> None:
        raise EpisodeLogError('episode log stopped: disk gone')

    monkeypatch.setattr(EpisodeWriter, 'flush', fail)
    errors, _ = record(tmp_path / 'recorder', ticks, pause=0.01)
    assert errors == ['episode log stopped: disk gone']
    assert not [path for path in (tmp_path / 'recorder').iterdir() if path.name[0] != '.']
