"""Training time until 0.95 success beside Stable-Baselines3's hindsight replay (`make bench-her`).

Three competitors with equal threads on the same simulation (this project's; Stable-Baselines3 gets
it through Gymnasium): this project's `best` recipe, TQC as tuned in rl-baselines3-zoo, and SAC as
tuned in VladPrytula/robotics_series. Success is the last step of 100 deterministic episodes with
the same seeds for all; evaluations are outside the clock.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import importlib.metadata
import importlib.util
import itertools
import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS
from policy_node.training.machine import processor

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / 'bench' / 'results'
OURS = 'this_project'
LABELS = {
    OURS: 'this project, `best`',
    'sb3_sac': 'Stable-Baselines3, SAC + HER',
    'sb3_tqc': 'Stable-Baselines3, TQC + HER (zoo)',
}
RUN_COLUMNS = ('task', 'competitor', 'seed', 'threads', 'limit', 'target', 'episodes')
COLUMNS = (*RUN_COLUMNS, 'seconds', 'env_steps', 'success')

Row = dict[str, Any]


class Run:
    """One competitor in a process of its own; its evaluations are collected as they come."""

    def __init__(self, competitor: str, task: str, options: argparse.Namespace) -> None:
        run = {'task': task, 'competitor': competitor}
        self.rows: list[Row] = []
        self._run = run | {name: getattr(options, name) for name in RUN_COLUMNS[2:]}
        command = [sys.executable, ROOT / 'bench' / 'her_worker.py', competitor, task]
        for name in ('limit', 'target', 'episodes', 'evaluate_every', 'threads', 'seed'):
            command += [f'--{name.replace("_", "-")}', getattr(options, name)]
        threads = str(options.threads)
        self._process = subprocess.Popen(
            [str(part) for part in command],
            stdout=subprocess.PIPE,
            text=True,
            env=os.environ | {'OMP_NUM_THREADS': threads, 'OPENBLAS_NUM_THREADS': threads},
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()

    def wait(self) -> None:
        """Waits for the end.

        Raises:
            SystemExit: If the process failed; its own message is above.
        """
        status = self._process.wait()
        self._reader.join()
        if status:
            raise SystemExit(f'bench_her: {" ".join(map(str, self._process.args))} failed')

    def stop(self) -> None:
        """Ends the process if it still runs; what was measured is kept."""
        self._process.kill()
        self._process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith('{'):
                self.rows.append(self._run | json.loads(line))
                print(self._run['competitor'], self._run['task'], line, end='', flush=True)


def measure(tasks: Sequence[str], options: argparse.Namespace) -> tuple[list[Row], bool]:
    """Trains all competitors on the tasks, in turn or side by side.

    Returns:
        The evaluations, and whether Ctrl-C ended them; then their limit is the time of the last.
    """
    runs: list[Run] = []
    is_interrupted = False
    try:
        for task, competitor in itertools.product(tasks, options.competitors):
            runs.append(Run(competitor, task, options))
            if not options.side_by_side:
                runs[-1].wait()
        for run in runs:
            run.wait()
    except KeyboardInterrupt:
        is_interrupted = True
        print('bench_her: interrupted; limits are where the competitors were', file=sys.stderr)
        for run in runs:
            run.stop()
            for row in run.rows:
                row['limit'] = run.rows[-1]['seconds']
    finally:
        for run in runs:
            run.stop()
    return [row for run in runs for row in run.rows], is_interrupted


def summarize(rows: Sequence[Row]) -> list[Row]:
    """One row per run: when it reached the target, None if it did not within the limit.

    `times_ours` is its time (the limit, if not reached: the true ratio is larger) over that of this
    project; None if this project did not reach the target.
    """
    runs: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        runs.setdefault(tuple(row[name] for name in RUN_COLUMNS), []).append(row)
    summary = []
    for evaluations in runs.values():
        last = evaluations[-1]
        result = {name: last[name] for name in RUN_COLUMNS}
        hit = next((row for row in evaluations if row['success'] >= row['target']), None)
        result['reached'] = hit is not None
        result['seconds'] = None if hit is None else hit['seconds']
        result['env_steps'] = None if hit is None else hit['env_steps']
        result['last_success'] = last['success']
        result['last_env_steps'] = last['env_steps']
        summary.append(result)
    for result in summary:
        ours = _of_ours(result, summary)
        seconds = result['seconds'] if result['reached'] else result['limit']
        result['times_ours'] = round(seconds / ours['seconds'], 2) if ours else None
    return summary


def _of_ours(result: Row, summary: Sequence[Row]) -> Row | None:
    same = ('task', 'seed', 'threads')
    for other in summary:
        if other['competitor'] == OURS and all(other[n] == result[n] for n in same):
            return other if other['reached'] else None
    return None


def table(summary: Sequence[Row]) -> str:
    """The summary as a Markdown table."""
    target = f'{summary[0]["target"]:g}' if summary else 'target'
    lines = [
        f'| task | competitor | threads | seconds to {target} | env steps to {target} | '
        'time / ours | success at the end, after steps |',
        '|---|---|---:|---:|---:|---:|---:|',
    ]
    for row in summary:
        more = '' if row['reached'] else '> '
        seconds = row['seconds'] if row['reached'] else row['limit']
        steps = row['env_steps'] if row['reached'] else row['last_env_steps']
        ratio = '-' if row['times_ours'] is None else f'{more}{row["times_ours"]:.1f}'
        lines.append(
            f'| {row["task"]} | {LABELS[row["competitor"]]} | {row["threads"]} | '
            f'{more}{seconds:,.0f} | {more}{steps:,} | {ratio} | '
            f'{row["last_success"]:.2f}, {row["last_env_steps"]:,} |'
        )
    return '\n'.join(lines)


def plot(rows: Sequence[Row], path: Path, title: str) -> None:
    """Success against seconds and against environment steps, one row of panels per task."""
    from matplotlib.figure import Figure

    tasks = list(dict.fromkeys(row['task'] for row in rows))
    figure = Figure(figsize=(11, 4 * len(tasks)), layout='constrained')
    axes = figure.subplots(len(tasks), 2, squeeze=False)
    for panels, task in zip(axes, tasks, strict=True):
        of_task = [row for row in rows if row['task'] == task]
        for axis, name in zip(panels, ('seconds', 'env_steps'), strict=True):
            for competitor in dict.fromkeys(row['competitor'] for row in of_task):
                curve = [row for row in of_task if row['competitor'] == competitor]
                label = LABELS[competitor].replace('`', '')
                values = [row['success'] for row in curve]
                axis.plot([row[name] for row in curve], values, marker='.', label=label)
            axis.axhline(of_task[0]['target'], color='tab:gray', linewidth=0.8)
            axis.set(xlabel=name.replace('_', ' '), ylabel='success', ylim=(-0.02, 1.02))
            axis.set_title(task)
            axis.grid(alpha=0.3)
    axes[0, 0].legend(loc='center right')
    figure.suptitle(title, fontsize=8)
    figure.savefig(path, dpi=110)


def describe_machine(options: argparse.Namespace) -> str:
    """Return machine and versions in one line."""
    tqc = ['sb3_contrib'] if 'sb3_tqc' in options.competitors else []
    versions = ('mujoco', 'torch', 'stable_baselines3', *tqc)
    parts = [
        processor(),
        f'{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} at the start',
        'side by side' if options.side_by_side else 'in turn',
        f'{options.threads} threads each' if options.threads > 1 else '1 thread each',
        *(f'{name} {importlib.metadata.version(name)}' for name in versions),
        f'{datetime.date.today()}',
    ]
    return ', '.join(parts)


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Reads the command line."""
    parser = argparse.ArgumentParser(prog='bench_her', description=__doc__)
    add = parser.add_argument
    tasks = ['FetchPush', 'FetchPickAndPlace']
    add('--tasks', nargs='+', choices=list(TASKS), default=tasks, metavar='TASK')
    add('--competitors', nargs='+', choices=LABELS, default=list(LABELS))
    add('--limit', type=float, default=7200, help='training seconds of each; default: 7200')
    add('--target', type=float, default=0.95, help='success that counts; default: 0.95')
    add('--episodes', type=int, default=100, help='of an evaluation; default: 100')
    add('--evaluate-every', type=int, default=10_000, help='env steps; default: 10000')
    add('--threads', type=int, default=os.cpu_count(), help='of each; default: all cores')
    add('--side-by-side', action='store_true', help='all competitors, on all tasks, at once')
    add('--seed', type=int, default=0)
    add('--output', type=Path, default=RESULTS, help='folder of CSV, table and PNG')
    options = parser.parse_args(arguments)
    for name in ('limit', 'target', 'episodes', 'evaluate_every', 'threads'):
        if getattr(options, name) <= 0:
            parser.error(f'--{name.replace("_", "-")} {getattr(options, name)}; allowed: above 0')
    return options


def write_csv(rows: Sequence[Row], columns: Sequence[str], path: Path, machine: str) -> None:
    """Write rows below a comment with the machine."""
    with path.open('w', newline='') as file:
        file.write(f'# {machine}\n')
        writer = csv.DictWriter(file, columns, lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)


def main(arguments: Sequence[str] | None = None) -> int:
    """Measures, and writes the files anew after each task. Returns the exit status."""
    options = parse_arguments(arguments)
    if 'sb3_tqc' in options.competitors and importlib.util.find_spec('sb3_contrib') is None:
        hint = 'pip install -r bench/requirements_her.txt'
        print(f'bench_her: sb3_contrib is missing; {hint}', file=sys.stderr)
        return 2
    machine = describe_machine(options)
    options.output.mkdir(parents=True, exist_ok=True)
    rows: list[Row] = []
    for tasks in [options.tasks] if options.side_by_side else [[task] for task in options.tasks]:
        found, is_interrupted = measure(tasks, options)
        rows += found
        if not rows:
            return 1
        summary = summarize(rows)
        write_csv(rows, COLUMNS, options.output / 'bench_her_curves.csv', machine)
        write_csv(summary, list(summary[0]), options.output / 'bench_her.csv', machine)
        (options.output / 'bench_her.md').write_text(f'{machine}\n\n{table(summary)}\n')
        plot(rows, options.output / 'bench_her.png', machine)
        if is_interrupted:
            break
    print(f'\n{machine}\n\n{table(summary)}')
    return 130 if is_interrupted else 0


if __name__ == '__main__':
    sys.exit(main())
