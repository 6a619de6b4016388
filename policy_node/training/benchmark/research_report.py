"""Data, figure and table of a study, under `docs/research/<name>`; renewed after every run.

A command renews the tasks that it runs; what is there of other tasks, from another day or machine,
stays.
"""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from policy_node.training.benchmark.jobs import Job
from policy_node.training.benchmark.measures import (
    GOOD_SUCCESS,
    are_apart,
    area_in_time,
    curve_of,
    measure_run,
    sum_up,
)
from policy_node.training.benchmark.research import Study
from policy_node.training.benchmark.results import (
    Band,
    Curve,
    aggregate,
    curve_rows,
    draw,
    machine,
    source_revisions,
    write_csv,
)
from policy_node.training.learning.recipes import STEP_COUNTS

# The page of a study keeps its table between these lines.
BEGIN, END = '<!-- table: written by `benchmark` -->', '<!-- end of the table -->'
_RUNS, _ARMS, _CURVES, _ABOUT = 'runs.csv', 'arms.csv', 'curves.csv', 'study.json'

_RUN = ('task', 'arm', 'seed')
"""Columns that name a run."""

Rows = list[dict[str, Any]]


def require_all_runs(jobs: Sequence[Job], output: Path) -> None:
    """Refuses a folder that holds runs of the jobs' tasks which are not among the jobs.

    They would be gone.

    Args:
        jobs: Jobs of a study, finished or not.
        output: Folder that `write_study` is to write.

    Raises:
        ValueError: If a run would be lost, or it cannot be seen whether; the line names one.
    """
    _tasks_told(output / _ABOUT)
    tasks = {job.config.task for job in jobs}
    ours = {(job.config.task, job.arm.name, job.config.seed) for job in jobs}
    found, evaluated = (_runs_of(output / name) for name in (_RUNS, _CURVES))
    if missing := [key for key in found if key[0] not in tasks and key not in evaluated]:
        raise ValueError(f'{output / _CURVES} has no evaluation of {_name(missing[0])}')
    lost = [key for key in found if key[0] in tasks and key not in ours]
    if lost:
        raise ValueError(
            f'{output} holds runs that this command has not ({len(lost)}), as {_name(lost[0])}: '
            'name their arms and seeds too, or another folder with --report'
        )


def _runs_of(path: Path) -> list[tuple[Any, ...]]:
    """Task, arm and seed of every row of a file."""
    try:
        return [_run_of(row) for row in read_rows(path)]
    except KeyError as error:
        raise ValueError(f'{path} has no column {error}') from None


def _run_of(row: Mapping[str, Any]) -> tuple[Any, ...]:
    return tuple(row[name] for name in _RUN)


def _name(run: tuple[Any, ...]) -> str:
    task, arm, seed = run
    return f'{task}/{arm}/seed{seed}'


def write_study(study: Study, jobs: Sequence[Job], output: Path, command: str) -> None:
    """Writes what the finished jobs of a study gave, beside what is there of other tasks.

    `runs.csv` (one row per run), `arms.csv` (medians and quartiles), `curves.csv` (every
    evaluation), `study.json` (by task: command, machine, revisions, settings), `figure.png`, and
    the table between its marks in `README.md`, which is made where there is none.

    Args:
        study: The study.
        jobs: Finished jobs.
        output: Folder.
        command: Command line, for the record.

    Raises:
        ValueError: If a file of the folder cannot be read.
    """
    output.mkdir(parents=True, exist_ok=True)
    found = [curve_of(job) for job in jobs]
    measured = [measure_run(job, curve) for job, curve in zip(jobs, found, strict=True)]
    runs = _with_other_tasks(study, measured, output / _RUNS)
    curves = _with_other_tasks(study, curve_rows(jobs, found), output / _CURVES)
    arms = sum_up_arms(study, runs, curves)
    about = _about(study, jobs, command, output / _ABOUT)
    for name, rows in ((_RUNS, runs), (_ARMS, arms), (_CURVES, curves)):
        write_csv(rows, output / name)
    (output / _ABOUT).write_text(json.dumps(about, indent=2) + '\n')
    labels = {arm.name: arm.label for arm in study.arms}
    draw(_bands(curves), labels, output / 'figure.png', paper_epochs=False)
    _renew(output / 'README.md', format_table(study, arms))


def read_rows(path: Path) -> Rows:
    """Rows of a CSV file, numbers as numbers; none where there is no file.

    Raises:
        ValueError: If it cannot be read.
    """
    if not path.is_file():
        return []
    try:
        rows = list(csv.DictReader(path.read_text().splitlines()))
    except OSError as error:
        raise ValueError(f'{path} cannot be read: {error.strerror}') from None
    return [{name: _value(text) for name, text in row.items()} for row in rows]


def _value(text: str | None) -> int | float | str:
    for kind in (int, float):
        try:
            return kind(text or '')
        except ValueError:
            continue
    return text or ''


def _with_other_tasks(study: Study, rows: Rows, path: Path) -> Rows:
    """New rows and those that a file has of other tasks, in the order of the study's tasks."""
    tasks = {row['task'] for row in rows}
    kept = [row for row in read_rows(path) if row['task'] not in tasks]
    order = {name: index for index, name in enumerate(study.tasks)}
    return sorted([*kept, *rows], key=lambda row: order.get(row['task'], len(order)))


def sum_up_arms(study: Study, runs: Rows, curves: Rows) -> Rows:
    """The rows of `arms.csv`: by task, in the order of the study's arms, those of before last.

    Args:
        study: The study.
        runs: Rows of `runs.csv`.
        curves: Rows of `curves.csv`.
    """
    order = {arm.name: index for index, arm in enumerate(study.arms)}
    by_run = {key: _curve(points) for key, points in _grouped(curves, *_RUN).items()}
    arms = []
    for of_task in _grouped(runs, 'task').values():
        groups = sorted(
            _grouped(of_task, 'arm').items(), key=lambda item: order.get(item[0][0], len(order))
        )
        # As long as the first arm took, which is the baseline where that was run.
        seconds = float(np.median([run['processor_seconds'] for run in groups[0][1]]))
        for _, group in groups:
            areas = (area_in_time(by_run[_run_of(run)], run, seconds) for run in group)
            pairs = zip(group, areas, strict=True)
            arms.append(sum_up([{**run, 'area_in_time': area} for run, area in pairs]))
    return arms


def _curve(points: Rows) -> Curve:
    """The evaluations of a run, from its rows of `curves.csv`."""
    return Curve(
        env_steps=np.array([row['env_steps'] for row in points], np.float64),
        success=np.array([float(row['success']) for row in points]),
        episodes=0,
    )


def _bands(rows: Rows) -> dict[str, dict[str, Band]]:
    """Median and quartiles over seeds, by task and arm, of the rows of `curves.csv`."""
    bands: dict[str, dict[str, Band]] = {}
    for (task, arm), points in _grouped(rows, 'task', 'arm').items():
        curves = [_curve(run) for run in _grouped(points, 'seed').values()]
        bands.setdefault(task, {})[arm] = aggregate(curves)
    return bands


def _grouped(rows: Rows, *names: str) -> dict[tuple[Any, ...], Rows]:
    groups: dict[tuple[Any, ...], Rows] = {}
    for row in rows:
        groups.setdefault(tuple(row[name] for name in names), []).append(row)
    return groups


def format_table(study: Study, arms: Sequence[Mapping[str, Any]]) -> str:
    """The Markdown table of a study: an arm per row, its quartiles beside each median."""
    labels = {arm.name: arm.label for arm in study.arms}
    lines = [
        f'| task | arm | seeds | area | steps to {GOOD_SUCCESS} (reached) | final success '
        '| processor time, s | area in equal time | samples per s | against the baseline |',
        '| --- | --- | --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    for row in arms:
        steps = row[f'steps_to_{GOOD_SUCCESS}_median']
        cells = [
            row['task'],
            f'`{row["arm"]}`: {labels.get(row["arm"], "an arm of before")}',
            str(row['seeds']),
            _quartiles(row, 'area'),
            f'{steps:,} ({row["reached"]})' if steps != '' else f'censored ({row["reached"]})',
            _quartiles(row, 'final_success'),
            f'{row["processor_seconds_median"]:.0f}',
            _quartiles(row, 'area_in_time'),
            f'{row["samples_per_processor_second_median"]:,.0f}',
            _against(study, row, arms),
        ]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def _against(study: Study, row: Mapping[str, Any], arms: Sequence[Mapping[str, Any]]) -> str:
    """In what the quartiles of an arm and of the baseline are apart."""
    base = study.arms[0].name
    found = [other for other in arms if (other['task'], other['arm']) == (row['task'], base)]
    if row['arm'] == base or not found:
        return ''
    if min(row['seeds'], found[0]['seeds']) < 5:
        return 'fewer than five seeds'
    words = []
    for name, label in (
        ('area', 'area'),
        ('area_in_time', 'area in time'),
        ('final_success', 'final'),
    ):
        if are_apart(row, found[0], name):
            better = row[f'{name}_median'] > found[0][f'{name}_median']
            words.append(f'{label} {"better" if better else "worse"}')
    return ', '.join(words) or 'not apart'


def _quartiles(row: Mapping[str, Any], name: str) -> str:
    values = (row[f'{name}_{part}'] for part in ('median', 'lower', 'upper'))
    return '{:.3f} ({:.3f} ... {:.3f})'.format(*values)


def _about(study: Study, jobs: Sequence[Job], command: str, path: Path) -> dict[str, Any]:
    """What `study.json` says; of other tasks, what it says already."""
    tasks = _tasks_told(path)
    for task, settings in _shared_settings(study, jobs).items():
        tasks[task] = {
            'command': command,
            'source_revisions': source_revisions([j for j in jobs if j.config.task == task]),
            'machine': machine(),
            'settings': settings,
        }
    return {
        'study': study.name,
        'request': study.request,
        'question': study.question,
        'arms': {arm.name: arm.own for arm in study.arms},
        'tasks': tasks,
    }


def _tasks_told(path: Path) -> dict[str, Any]:
    """What a `study.json` says of its tasks."""
    try:
        return dict(json.loads(path.read_text())['tasks']) if path.is_file() else {}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ValueError(f'{path} is no record of a study: {error!r}') from None


def _shared_settings(study: Study, jobs: Sequence[Job]) -> dict[str, dict[str, Any]]:
    """By task, the fields of `TrainConfig` that all arms share."""
    own = {'seed', *(name for arm in study.arms for name in arm.changes)}
    if 'control_hz' in own:
        own |= set(STEP_COUNTS)
    # Last those whose arms multiply nothing: what others multiply is told by its own value.
    ordered = sorted(jobs, key=lambda job: not job.arm.factors)
    configs = {job.config.task: dataclasses.asdict(job.config) for job in ordered}
    return {
        task: {name: value for name, value in config.items() if name not in own}
        for task, config in configs.items()
    }


def _renew(page: Path, table: str) -> None:
    """Puts the table between its marks."""
    text = page.read_text() if page.is_file() else f'{BEGIN}\n{END}\n'
    if BEGIN in text and END in text:
        before, after = text.split(BEGIN)[0], text.split(END, 1)[1]
        page.write_text(f'{before}{BEGIN}\n{table}{END}{after}')
