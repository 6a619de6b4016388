"""Measure the CPU time and memory of logging (`make bench-episodes`).

The ticks of one episode are recorded beforehand; then the recorder of `sim_node` writes them over
and over, paced, so that files are completed behind the back of running ticks as on a robot.
"""

from __future__ import annotations

import argparse
import dataclasses
import gc
import os
import platform
import shutil
import sys
import tempfile
import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from fetch_hand_sim.episodes.recorder import EpisodeRecorder, RecordingContext
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec
from msgs_spec.tasks import TASKS
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import TopicSpec, topic

CONTROL_PERIOD = 0.04
# Targets of the project.
MAX_CPU_SHARE, MAX_ADDED_MS, MAX_GROWTH_MIB = 0.02, 0.5, 8.0

Messages = list[tuple[TopicSpec, bytes]]


class Robot:
    """One episode, recorded beforehand, and a recorder to write it."""

    def __init__(self, task: str, directory: Path, with_compiled_model: bool) -> None:
        simulation = Simulation(task, num_threads=1)
        self.commands = topic(simulation.spec, 'commands')
        self.command = TopicCodec(self.commands).encode(0, np.zeros(self.commands.size))
        self.ticks = _episode(simulation)
        self.directory = directory
        self.logged = threading.Semaphore(0)
        self._error = ''
        context = RecordingContext(simulation, with_compiled_model=with_compiled_model)
        self.recorder = EpisodeRecorder(
            directory,
            attachments=context.attachments,
            metadata=context.metadata,
            on_error=self._fail,
            on_logged=lambda _: self.logged.release(),
        )

    def write(self, tick: Tick, messages: Messages) -> float:
        """Logs a tick and the command after it; returns the seconds it took."""
        began = time.perf_counter()
        self.recorder.record(tick, messages)
        self.recorder.record_received(self.commands, self.command)
        return time.perf_counter() - began

    def discard(self) -> None:
        """Waits for an episode to be completed and removes it.

        Raises:
            SystemExit: If logging failed.
        """
        self.logged.acquire()
        if self._error:
            raise SystemExit(f'bench_episode_log: {self._error}')
        for path in self.directory.iterdir():
            if not path.name.startswith('.'):
                shutil.rmtree(path)

    def _fail(self, error: str) -> None:
        self._error = error
        # No further episode will be completed.
        self.logged.release()


def _episode(simulation: Simulation) -> list[tuple[Tick, Messages]]:
    runner, encoder = EpisodeRunner(simulation), TickEncoder(simulation.spec)
    ticks: list[tuple[Tick, Messages]] = []
    while not ticks or not runner.is_between_episodes:
        tick = runner.advance(runner.resting_command())
        ticks.append((tick, encoder.encode(tick, latched=tick.status.phase != 'running')))
    return ticks


def cost(robot: Robot, episodes: int, speed: float) -> tuple[float, np.ndarray]:
    """Logs paced episodes.

    Returns:
        Processor time of logging as a share of simulated time, all threads together, and the
        seconds that each tick took longer.
    """
    added, waiting_cpu = [], 0.0
    cpu_began, due = time.process_time(), time.perf_counter()
    for _ in range(episodes):
        for tick, messages in robot.ticks:
            due += CONTROL_PERIOD / speed
            before = time.thread_time()
            time.sleep(max(0.0, due - time.perf_counter()))
            waiting_cpu += time.thread_time() - before
            added.append(robot.write(tick, messages))
        robot.discard()
    cpu = time.process_time() - cpu_began - waiting_cpu
    return cpu / (len(added) * CONTROL_PERIOD), np.array(added)


def memory(robot: Robot, episodes: int) -> list[tuple[int, float]]:
    """Resident MiB after some numbers of short episodes."""
    first, second, *_, last = robot.ticks
    marks = sorted({episodes // 10, episodes // 4, episodes // 2, episodes})
    sizes = []
    for number in range(1, episodes + 1):
        for index, (tick, messages) in enumerate((first, second, last)):
            stamped = dataclasses.replace(tick, stamp_ns=10**9 + index * 40_000_000)
            robot.write(stamped, messages)
        robot.discard()
        if number in marks:
            gc.collect()
            pages = int(Path('/proc/self/statm').read_text().split()[1])
            sizes.append((number, pages * os.sysconf('SC_PAGE_SIZE') / 2**20))
    return sizes


def main(arguments: Sequence[str] | None = None) -> int:
    """Prints both tables; returns 1 if a target is missed."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', choices=TASKS, default='HandManipulateBlockFull')
    parser.add_argument('--episodes', type=int, default=60, help='paced; default: 60')
    parser.add_argument('--speed', type=float, default=4.0, help='times real time; default: 4')
    parser.add_argument('--short-episodes', type=int, default=10_000)
    parser.add_argument('--directory', type=Path, help='where to log; default: the temporary one')
    options = parser.parse_args(arguments)
    missed = 0
    console = Console(width=120)
    table = Table('compiled model', 'ticks', 'share of a core', 'added p50, ms', 'p99.9, ms', 'max')
    for with_model in (False, True):
        with tempfile.TemporaryDirectory(dir=options.directory) as directory:
            robot = Robot(options.task, Path(directory), with_model)
            share, added = cost(robot, options.episodes, options.speed)
            robot.recorder.close('end')
        p50, p999 = np.percentile(added * 1e3, [50, 99.9])
        missed += share > MAX_CPU_SHARE or p999 > MAX_ADDED_MS
        cells = (f'{share:.2%}', f'{p50:.3f}', f'{p999:.3f}', f'{added.max() * 1e3:.3f}')
        table.add_row('yes' if with_model else 'no', str(added.size), *cells)
    console.print(table)
    with tempfile.TemporaryDirectory(dir=options.directory) as directory:
        robot = Robot(options.task, Path(directory), with_compiled_model=False)
        sizes = memory(robot, options.short_episodes)
        robot.recorder.close('end')
    table = Table('short episodes', 'resident, MiB')
    for number, size in sizes:
        table.add_row(str(number), f'{size:.1f}')
    console.print(table)
    missed += sizes[-1][1] - sizes[0][1] > MAX_GROWTH_MIB
    print(
        f'{options.task}; {platform.machine()}, {os.cpu_count()} cores, '
        f'load {os.getloadavg()[0]:.1f}'
    )
    return 1 if missed else 0


if __name__ == '__main__':
    sys.exit(main())
