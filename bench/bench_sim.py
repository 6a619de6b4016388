"""Environment steps per second of all thirteen tasks, side by side in one run (`make bench-sim`).

Measured are this project, the same with the disturbances `hardware`, EnvPool, Gymnasium-Robotics
(one process with one environment; or one process per environment in an `AsyncVectorEnv`) and, as
the limit, MuJoCo's batch alone: on the model as published, and as tuned by this project. All play
whole episodes of random actions, ten steps each in turn, so that a disturbance of the machine hits
all alike; ratios are medians over these turns.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import importlib.metadata
import json
import os
import statistics
import subprocess
import sys
import tempfile
import venv
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.machine import processor

ROOT = Path(__file__).resolve().parents[1]
PEERS = ROOT / '.venv-bench'
RESULTS = ROOT / 'bench' / 'results'
NUM_ENVS = 64
STEPS_PER_TURN = 10
OURS = 'this_project'
IMPLEMENTATIONS = (
    OURS,
    'disturbed',
    'bare_physics',
    'tuned_physics',
    'envpool',
    'gymnasium_robotics',
)
IN_PEERS_ENVIRONMENT = ('envpool', 'gymnasium_robotics')


def create_peers_environment() -> None:
    """Installs the peers into an environment of their own."""
    python = PEERS / 'bin' / 'python'
    if not python.exists():
        venv.create(PEERS, with_pip=True)
    requirements = ROOT / 'bench' / 'requirements.txt'
    subprocess.run([python, '-m', 'pip', 'install', '-q', '-r', requirements], check=True)


class Worker:
    """A process that plays episodes of one implementation on request."""

    def __init__(self, implementation: str, task: str, threads: int, path: Path) -> None:
        """Starts the process and waits until it is ready."""
        python = PEERS / 'bin' / 'python' if implementation in IN_PEERS_ENVIRONMENT else None
        arguments = [implementation, task, TASKS[task].reference_id, NUM_ENVS, threads, path]
        # -O: Gymnasium-Robotics 1.4.2 stops at an assertion on this MuJoCo.
        command = [python or sys.executable, '-O', ROOT / 'bench' / 'sim_worker.py', *arguments]
        environment = {'PYTHONPATH': str(ROOT)} if python is None else {'PYTHONPATH': ''}
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            env=os.environ | environment | {'OMP_NUM_THREADS': '1', 'OPENBLAS_NUM_THREADS': '1'},
        )
        self._answer()

    def play(self, steps: int) -> dict[str, float]:
        """Plays a number of steps in all simulations."""
        assert self._process.stdin is not None
        self._process.stdin.write(f'{steps}\n')
        self._process.stdin.flush()
        return self._answer()

    def close(self) -> None:
        """Ends the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=20)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _answer(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            arguments = self._process.args
            raise SystemExit(f'a worker stopped; start it by hand to see why: {arguments}')
        return json.loads(line)


@contextmanager
def workers_of(task: str, threads: int) -> Iterator[dict[str, Worker]]:
    """All implementations of a task, ready to play."""
    with ExitStack() as stack:
        path = Path(stack.enter_context(tempfile.TemporaryDirectory())) / 'episode.npz'
        workers = {}
        for name in IMPLEMENTATIONS:
            workers[name] = Worker(name, task, threads, path)
            stack.callback(workers[name].close)
        yield workers


def measure(task: str, threads: int, episodes: int) -> dict[str, Any]:
    """One row of the table."""
    played: dict[str, list[dict[str, float]]] = {name: [] for name in IMPLEMENTATIONS}
    turns = TASKS[task].episode_ticks // STEPS_PER_TURN
    with workers_of(task, threads) as workers:
        # The episode that warms everything up does not count.
        for _ in range((1 + episodes) * turns):
            for name, worker in workers.items():
                played[name].append(worker.play(STEPS_PER_TURN))
    counted = {name: times[turns:] for name, times in played.items()}
    speeds = {name: [t['steps'] / t['seconds'] for t in times] for name, times in counted.items()}
    row: dict[str, Any] = {'task': task, 'threads': threads}
    row |= {name: statistics.median(values) for name, values in speeds.items()}
    row |= {
        f'ratio_{name}': _median_ratio(speeds[OURS], speeds[name]) for name in IMPLEMENTATIONS[1:]
    }
    # The physics alone has no resets.
    whole = {name: _speed_with_resets(counted[name], turns) for name in (OURS, 'envpool')}
    row |= {f'{name}_with_resets': statistics.median(values) for name, values in whole.items()}
    row['ratio_envpool_with_resets'] = _median_ratio(whole[OURS], whole['envpool'])
    return row


def _speed_with_resets(times: list[dict[str, float]], turns: int) -> list[float]:
    """Steps per second of each episode with the reset after it."""
    speeds = []
    for first in range(0, len(times), turns):
        episode = times[first : first + turns]
        seconds = sum(part['seconds'] + part['reset_seconds'] for part in episode)
        speeds.append(sum(part['steps'] for part in episode) / seconds)
    return speeds


def _median_ratio(ours: list[float], theirs: list[float]) -> float:
    return statistics.median(a / b for a, b in zip(ours, theirs, strict=True))


def describe_machine() -> str:
    """Return machine and versions in one line."""
    parts = [
        processor(),
        f'{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start',
        *(f'{name} {importlib.metadata.version(name)}' for name in ('mujoco', 'numpy')),
        'EnvPool 1.2.5, Gymnasium-Robotics 1.4.2',
        f'{NUM_ENVS} simulations',
        f'{datetime.date.today()}',
    ]
    return ', '.join(parts)


def table(rows: list[dict[str, Any]]) -> str:
    """The results as a Markdown table."""
    header = (
        '| task | threads | this project | with disturbances | '
        "of the published model's physics | "
        'of the tuned physics | EnvPool | x | with resets x | Gymnasium-Robotics | x |'
    )
    lines = [header, '|---|' + '---:|' * 10]
    for row in rows:
        lines.append(
            f'| {row["task"]} | {row["threads"]} | {row[OURS]:,.0f} | '
            f'{1.0 / row["ratio_disturbed"]:.1%} | '
            f'{row["ratio_bare_physics"]:.0%} | {row["ratio_tuned_physics"]:.0%} | '
            f'{row["envpool"]:,.0f} | {row["ratio_envpool"]:.2f} | '
            f'{row["ratio_envpool_with_resets"]:.2f} | '
            f'{row["gymnasium_robotics"]:,.0f} | {row["ratio_gymnasium_robotics"]:.1f} |'
        )
    for threads in sorted({row['threads'] for row in rows}):
        part = [row for row in rows if row['threads'] == threads]
        names = (*IMPLEMENTATIONS[1:], 'envpool_with_resets')
        mean = {n: statistics.geometric_mean(row[f'ratio_{n}'] for row in part) for n in names}
        lines.append(
            f'| *geometric mean* | {threads} | | {1.0 / mean["disturbed"]:.1%} | '
            f'{mean["bare_physics"]:.0%} | {mean["tuned_physics"]:.0%} | | {mean["envpool"]:.2f} | '
            f'{mean["envpool_with_resets"]:.2f} | | {mean["gymnasium_robotics"]:.1f} |'
        )
    return '\n'.join(lines)


def plot(rows: list[dict[str, Any]], path: Path, title: str) -> None:
    """Bars per task, one panel per number of threads."""
    from matplotlib.figure import Figure

    threads = sorted({row['threads'] for row in rows})
    figure = Figure(figsize=(12, 4.5 * len(threads)))
    axes = figure.subplots(len(threads), 1, squeeze=False)
    for axis, number in zip(axes[:, 0], threads, strict=True):
        part = [row for row in rows if row['threads'] == number]
        for index, name in enumerate(IMPLEMENTATIONS):
            places = [place + 0.14 * (index - 2.5) for place in range(len(part))]
            label = name.replace('_', ' ')
            axis.bar(places, [row[name] for row in part], width=0.14, label=label)
        labels = [row['task'].replace('HandManipulate', 'Hand ') for row in part]
        axis.set_xticks(range(len(part)), labels, rotation=25, ha='right')
        axis.set_ylabel('environment steps per second')
        axis.set_title(f'{number} thread{"s" if number > 1 else ""}')
    axes[0, 0].legend()
    figure.suptitle(title, fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def parse_arguments() -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--tasks', nargs='+', choices=list(TASKS), default=list(TASKS))
    parser.add_argument('--threads', nargs='+', type=int, default=[1, os.cpu_count() or 1])
    parser.add_argument('--episodes', type=int, default=3, help='per implementation; default 3')
    parser.add_argument('--output', type=Path, default=RESULTS, help='directory of CSV and PNG')
    return parser.parse_args()


def main() -> None:
    """Measures, prints the table, writes CSV and PNG."""
    arguments = parse_arguments()
    machine = describe_machine()
    create_peers_environment()
    rows = []
    for threads in dict.fromkeys(arguments.threads):
        for task in arguments.tasks:
            rows.append(measure(task, threads, arguments.episodes))
            print(table(rows[-1:]).splitlines()[2], flush=True)
    print(f'\n{machine}\n\n{table(rows)}')
    arguments.output.mkdir(parents=True, exist_ok=True)
    with open(arguments.output / 'bench_sim.csv', 'w', newline='') as file:
        file.write(f'# {machine}\n')
        writer = csv.DictWriter(file, list(rows[0]), lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    plot(rows, arguments.output / 'bench_sim.png', machine)


if __name__ == '__main__':
    main()
