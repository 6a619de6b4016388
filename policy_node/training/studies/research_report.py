"""Data, figure and table of a study, under `docs/research/<name>`; renewed after every run.

A command adds its runs; what is there already, from another day or machine, stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies.files import write_files
from policy_node.training.studies.jobs import Job
from policy_node.training.studies.measures import (
    GOOD_SUCCESS,
    are_apart,
    area_in_time,
    compared,
    sum_up,
)
from policy_node.training.studies.results import Band, Curve, aggregate, draw, to_csv
from policy_node.training.studies.stored_runs import RUN, Rows, StoredRuns, run_of
from policy_node.training.studies.study import Study

# The page of a study keeps its table between these lines.
BEGIN, END = '<!-- table: written by `benchmark` -->', '<!-- end of the table -->'
ARMS, FIGURE, PAGE = 'arms.csv', 'figure.png', 'README.md'
# A difference is claimed from so many seeds on.
_ENOUGH_SEEDS = 5


def write_study(study: Study, jobs: Sequence[Job], output: Path, command: str) -> None:
    """Writes what the finished jobs of a study gave, beside the runs that are there.

    `runs.csv` (one row per run), `arms.csv` (medians and quartiles), `curves.csv` (every
    evaluation), `study.json` (by task: commands and settings), `figure.png`, and the table between
    its marks in `README.md`, which is made where there is none.

    Args:
        study: The study.
        jobs: Finished jobs.
        output: Folder.
        command: Command line, for the record.

    Raises:
        ValueError: If a file of the folder cannot be read.
        OSError: If the report cannot be written; that of before stays then.
    """
    with alone_in(output):
        stored = StoredRuns.read(output)
        stored.add(jobs, command)
        data = stored.files(study)
        arms = sum_up_arms(study, stored.runs, stored.curves)
        labels = {arm.name: arm.label for arm in study.arms}
        contents = {
            ARMS: to_csv(arms),
            FIGURE: draw(_bands(stored.curves), labels, paper_epochs=False),
            PAGE: _renewed(output / PAGE, format_table(study, arms)),
        }
        # The page last: it is what people look at, the rest is what it is made of.
        write_files(data | {output / name: content for name, content in contents.items()})


def sum_up_arms(study: Study, runs: Rows, curves: Rows) -> Rows:
    """The rows of `arms.csv`: by task, in the order of the study's arms, those of before last.

    Args:
        study: The study.
        runs: Rows of `runs.csv`.
        curves: Rows of `curves.csv`.
    """
    order = {arm.name: index for index, arm in enumerate(study.arms)}
    by_run = {key: _curve(points) for key, points in _grouped(curves, *RUN).items()}
    arms = []
    for of_task in _grouped(runs, 'task').values():
        groups = sorted(
            _grouped(of_task, 'arm').items(), key=lambda item: order.get(item[0][0], len(order))
        )
        # As long as the first arm took, which is the baseline where that was run.
        seconds = _median_seconds(groups[0][1])
        measured: dict[str, Rows] = {}
        for (arm,), group in groups:
            areas = (_area_in_time(by_run[run_of(run)], run, seconds) for run in group)
            pairs = zip(group, areas, strict=True)
            measured[arm] = [{**run, 'area_in_time': area} for run, area in pairs]
        first = study.arms[0].name
        baseline = measured.get(first, [])
        for arm, group in measured.items():
            arms.append(sum_up(group) | compared(group, [] if arm == first else baseline))
    return arms


def _median_seconds(runs: Rows) -> dict[str, float]:
    """Median processor time of runs, by machine."""
    return {
        machine: float(np.median([run['processor_seconds'] for run in group]))
        for (machine,), group in _grouped(runs, 'machine').items()
    }


def _area_in_time(
    curve: Curve, run: Mapping[str, Any], seconds: Mapping[str, float]
) -> float | None:
    """Area in as much time as the baseline took on the same machine; None if it never ran there."""
    if run['machine'] not in seconds:
        return None
    return area_in_time(curve, run, seconds[run['machine']])


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
            *_times(row),
            _against(study, row, arms),
        ]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def _times(row: Mapping[str, Any]) -> tuple[str, str, str]:
    """Processor time, area in equal time, samples per second: of the runs that have them."""
    if not row['timed']:
        return ('-',) * 3
    some = '' if row['timed'] == row['seeds'] else f', of {row["timed"]}'
    return (
        f'{row["processor_seconds_median"]:.0f}{some}',
        _quartiles(row, 'area_in_time') + some,
        f'{row["samples_per_processor_second_median"]:,.0f}{some}',
    )


def _against(study: Study, row: Mapping[str, Any], arms: Sequence[Mapping[str, Any]]) -> str:
    """In what an arm and the baseline are apart."""
    base = study.arms[0].name
    found = [other for other in arms if (other['task'], other['arm']) == (row['task'], base)]
    if row['arm'] == base or not found:
        return ''
    if min(row['seeds'], found[0]['seeds']) < _ENOUGH_SEEDS:
        return 'fewer than five seeds'
    words = []
    for name, label, runs in (
        ('area', 'area', 'seeds'),
        ('area_in_time', 'area in time', 'timed'),
        ('final_success', 'final', 'seeds'),
    ):
        enough = min(row[runs], found[0][runs]) >= _ENOUGH_SEEDS
        if enough and are_apart(row, found[0], name):
            better = row[f'{name}_median'] > found[0][f'{name}_median']
            words.append(f'{label} {"better" if better else "worse"}')
    return ', '.join(words) or 'not apart'


def _quartiles(row: Mapping[str, Any], name: str) -> str:
    values = (row[f'{name}_{part}'] for part in ('median', 'lower', 'upper'))
    return '{:.3f} ({:.3f} ... {:.3f})'.format(*values)


def _renewed(page: Path, table: str) -> bytes:
    """A page with the table between its marks; one that has none stays as it is."""
    text = page.read_text() if page.is_file() else f'{BEGIN}\n{END}\n'
    if BEGIN in text and END in text:
        before, after = text.split(BEGIN)[0], text.split(END, 1)[1]
        text = f'{before}{BEGIN}\n{table}{END}{after}'
    return text.encode()
