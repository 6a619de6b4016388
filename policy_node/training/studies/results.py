"""Curves, figure and tables of a benchmark: median and quartiles over seeds."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Console
from rich.table import Table

from fetch_hand_sim.datasets.writing import alone_in
from msgs_spec.arrays import Array
from msgs_spec.tasks import task_spec
from policy_node.policies.checkpoint import read_info
from policy_node.policies.files import to_json, write_files
from policy_node.training.runs.run_folder import LATEST_FILE, PROGRESS_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.studies.jobs import ARMS, BEST_ARM, Job
from policy_node.training.studies.machines import machine
from policy_node.training.studies.published import BEST, RERUN

# An epoch of the paper: 50 cycles of 2 episodes on each of 19 workers.
EPISODES_PER_EPOCH = 1900
FAST_SUCCESS = 0.95
_ARMS = {**ARMS, BEST_ARM.name: BEST_ARM}

_Value = TypeVar('_Value')


@dataclass(frozen=True, slots=True)
class Curve:
    """Deterministic evaluations of one run.

    Attributes:
        env_steps: (n,) ascending.
        success: (n,) success at the last step.
        episodes: Episodes of the last evaluation.
    """

    env_steps: Array
    success: Array
    episodes: int

    def steps_to(self, success: float) -> float:
        """Environment steps of the first evaluation with this success; infinity if none has it."""
        reached = np.flatnonzero(self.success >= success)
        return float(self.env_steps[reached[0]]) if reached.size else float('inf')


@dataclass(frozen=True, slots=True)
class Band:
    """Median and quartiles over seeds on common steps, each (n,)."""

    env_steps: Array
    median: Array
    lower: Array
    upper: Array


def read_curve(path: Path) -> Curve:
    """Reads the evaluations of a `progress.csv`.

    Raises:
        ValueError: If there is no evaluation.
    """
    evaluated = [row for row in read_progress(path) if 'eval_success' in row]
    if not evaluated:
        raise ValueError(f'{path} holds no evaluation')
    return Curve(
        env_steps=np.array([row['env_steps'] for row in evaluated]),
        success=np.array([row['eval_success'] for row in evaluated]),
        episodes=int(evaluated[-1]['eval_episodes']),
    )


def aggregate(curves: Sequence[Curve]) -> Band:
    """Median and quartiles where all curves have begun and none has ended.

    Evaluations of resumed runs fall on other steps; between evaluations a curve is a straight line.
    """
    first = max(float(curve.env_steps[0]) for curve in curves)
    last = min(float(curve.env_steps[-1]) for curve in curves)
    steps = np.unique(np.concatenate([curve.env_steps for curve in curves]))
    steps = steps[(steps >= first) & (steps <= last)]
    values = np.stack([np.interp(steps, curve.env_steps, curve.success) for curve in curves])
    lower, median, upper = np.percentile(values, [25, 50, 75], axis=0)
    return Band(steps, median, lower, upper)


def summarize(task: str, arm: str, curves: Sequence[Curve]) -> dict[str, Any]:
    """One row of the table: final success over seeds and what is published."""
    final = [float(curve.success[-1]) for curve in curves]
    lower, median, upper = (float(x) for x in np.percentile(final, [25, 50, 75]))
    # The middle of an even number with an unreached one has no value: the slower one counts.
    fast = sorted(curve.steps_to(FAST_SUCCESS) for curve in curves)[len(curves) // 2]
    rerun, best = RERUN.get((task, arm)), BEST.get(task)
    return {
        'task': task,
        'arm': arm,
        'seeds': len(curves),
        'env_steps': int(min(curve.env_steps[-1] for curve in curves)),
        'evaluation_episodes': curves[0].episodes,
        'final_median': median,
        'final_lower_quartile': lower,
        'final_upper_quartile': upper,
        'final_of_each_seed': final,
        'median_steps_to_0.95': None if np.isinf(fast) else int(fast),
        'published_rerun': str(rerun) if rerun else None,
        'published_best': str(best) if best else None,
    }


def by_arm(jobs: Sequence[Job], values: Sequence[_Value]) -> dict[str, dict[str, list[_Value]]]:
    """What belongs to jobs, by task and arm, in the order of the jobs."""
    groups: dict[str, dict[str, list[_Value]]] = {}
    for job, value in zip(jobs, values, strict=True):
        groups.setdefault(job.config.task, {}).setdefault(job.arm.name, []).append(value)
    return groups


def source_revisions(jobs: Sequence[Job]) -> list[str]:
    """Revisions of the source that trained the jobs, each once."""
    return sorted({read_info(job.folder / LATEST_FILE).source_revision for job in jobs})


def write_report(jobs: Sequence[Job], output: Path, command: str) -> None:
    """Writes figure (PNG), curves (CSV) and table (text, CSV, JSON), and prints the table.

    Args:
        jobs: Finished jobs.
        output: Folder.
        command: Command line, for the record.

    Raises:
        ValueError: If a file of a job cannot be read.
        OSError: If the report cannot be written; that of before stays then.
    """
    found = [read_curve(job.folder / PROGRESS_FILE) for job in jobs]
    revisions, groups = source_revisions(jobs), by_arm(jobs, found)
    table = [summarize(t, a, curves) for t, arms in groups.items() for a, curves in arms.items()]
    about = {'command': command, 'source_revisions': revisions, 'machine': machine()}
    bands = {t: {a: aggregate(curves) for a, curves in arms.items()} for t, arms in groups.items()}
    text = format_table(table)
    contents = {
        'benchmark_curves.csv': to_csv(curve_rows(jobs, found)),
        'benchmark.csv': to_csv(table),
        'benchmark.json': to_json({**about, 'results': table}),
        'benchmark.png': draw(bands, {arm.name: arm.label for arm in _ARMS.values()}),
        'benchmark.txt': text.encode(),
    }
    with alone_in(output):
        write_files({output / name: content for name, content in contents.items()})
    print(text, end='')
    print(f'figure and tables in {output}')


def format_table(table: Sequence[dict[str, Any]]) -> str:
    """The results as text, and below them the published numbers with their kind and source."""
    columns = ('task', 'arm', 'seeds', 'steps', 'median', 'quartiles', 'steps to 0.95')
    results = Table(*columns, title='success at the last step, over seeds')
    published = Table('task', 'arm', 'published success (kind; source)')
    for row in table:
        fast, label = row['median_steps_to_0.95'], _ARMS[row['arm']].label
        results.add_row(
            row['task'],
            label,
            str(row['seeds']),
            f'{row["env_steps"]:,}',
            f'{row["final_median"]:.3f}',
            f'{row["final_lower_quartile"]:.3f} ... {row["final_upper_quartile"]:.3f}',
            'not reached' if fast is None else f'{fast:,}',
        )
        published.add_row(row['task'], label, row['published_rerun'] or 'none')
    for row in {row['task']: row for row in table}.values():
        published.add_row(row['task'], 'best of any method', row['published_best'] or 'none')
    console = Console(file=io.StringIO(), width=110)
    console.print(results, published)
    return str(console.file.getvalue())  # type: ignore[attr-defined]


# Colours there are; the next curves are dashed.
_COLORS = 10
# Most curves that a legend inside a panel names.
_MOST_INSIDE = 4


def draw(
    bands: Mapping[str, Mapping[str, Band]],
    labels: Mapping[str, str],
    paper_epochs: bool = True,
) -> bytes:
    """A PNG with one panel per task: the median of each arm over its quartiles.

    Args:
        bands: By task and arm.
        labels: By arm, in the order of their colours.
        paper_epochs: Whether the epochs of the paper are marked on a second axis; without them a
            step is one of 40 ms, at whatever rate.
    """
    from matplotlib.figure import Figure

    top = _top_of_axis(bands)
    columns = min(len(bands), 4)
    rows = -(-len(bands) // columns)
    figure = Figure(figsize=(4.6 * columns + 0.8, 3.9 * rows), layout='constrained')
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    for axes in panels[len(bands) :]:
        axes.set_visible(False)
    for axes, (task, arms) in zip(panels, bands.items(), strict=False):
        for index, (arm, label) in enumerate(labels.items()):
            if arm in arms:
                band, color = arms[arm], f'C{index}'
                style = '--' if index >= _COLORS else '-'
                axes.fill_between(band.env_steps, band.lower, band.upper, color=color, alpha=0.2)
                axes.plot(band.env_steps, band.median, style, color=color, label=label)
        _label(axes, task, top, paper_epochs)
    _name_curves(figure, list(panels[: len(bands)]), columns)
    file = io.BytesIO()
    figure.savefig(file, dpi=130)
    return file.getvalue()


def _name_curves(figure: Any, panels: Sequence[Any], columns: int) -> None:
    """A legend inside the first panel; below all where it would hide the curves."""
    named: dict[str, Any] = {}
    for axes in panels:
        handles, labels = axes.get_legend_handles_labels()
        named |= zip(labels, handles, strict=True)
    if len(named) <= _MOST_INSIDE:
        panels[0].legend(named.values(), named.keys(), loc='best', fontsize='small')
        return
    lines = -(-len(named) // columns)
    width, height = figure.get_size_inches()
    figure.set_size_inches(width, height + 0.2 * lines)
    place = {'loc': 'outside lower center', 'ncols': columns}
    figure.legend(named.values(), named.keys(), fontsize='small', **place)


def _top_of_axis(bands: Mapping[str, Mapping[str, Band]]) -> float:
    """Success at the top of every panel: 1, or less where no arm comes near half of it."""
    # Curves that have no step in common have an empty band.
    tops = [band.upper for arms in bands.values() for band in arms.values() if band.upper.size]
    highest = max((float(upper.max()) for upper in tops), default=0.0)
    return 1.0 if highest > 0.4 else max(1.25 * highest, 0.05)


def _label(axes: Any, task: str, top: float, paper_epochs: bool) -> None:
    from matplotlib.ticker import EngFormatter

    unit = 'environment steps' if paper_epochs else 'steps of 40 ms'
    axes.set(xlabel=unit, ylabel='success at the last step')
    axes.set_ylim(-0.02 * top, 1.02 * top)
    axes.xaxis.set_major_formatter(EngFormatter(sep=''))
    axes.set_title(task)
    axes.grid(alpha=0.3)
    if not paper_epochs:
        return
    steps = EPISODES_PER_EPOCH * task_spec(task).episode_ticks
    epochs = axes.secondary_xaxis('top', functions=(lambda x: x / steps, lambda x: x * steps))
    epochs.set_xlabel("the paper's epochs")


def curve_rows(jobs: Sequence[Job], curves: Sequence[Curve]) -> list[dict[str, Any]]:
    """Every evaluation of jobs, as rows of a CSV file."""
    return [
        {
            'task': job.config.task,
            'arm': job.arm.name,
            'seed': job.config.seed,
            'env_steps': int(steps),
            'success': f'{success:.6g}',
        }
        for job, curve in zip(jobs, curves, strict=True)
        for steps, success in zip(curve.env_steps, curve.success, strict=True)
    ]


def to_csv(rows: Sequence[Mapping[str, Any]]) -> bytes:
    """Rows as CSV; a column that a row has not is empty."""
    # The last rows are the newest: files of before lack columns that came later.
    columns = dict.fromkeys(name for row in reversed(rows) for name in row)
    file = io.StringIO()
    writer = csv.DictWriter(file, list(columns), lineterminator='\n')
    writer.writeheader()
    writer.writerows(rows)
    return file.getvalue().encode()
