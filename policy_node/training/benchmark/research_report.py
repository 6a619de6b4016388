"""Data, figure and table of a study, under `docs/research/<name>`; renewed after every run."""

from __future__ import annotations

import csv
import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from policy_node.training.benchmark.jobs import Job
from policy_node.training.benchmark.measures import (
    GOOD_SUCCESS,
    are_apart,
    curve_of,
    measure_run,
    sum_up,
)
from policy_node.training.benchmark.research import STEP_COUNTS, Study
from policy_node.training.benchmark.results import (
    aggregate,
    by_arm,
    draw,
    machine,
    source_revisions,
    write_curves,
)

# The page of a study keeps its table between these lines.
BEGIN, END = '<!-- table: written by `benchmark` -->', '<!-- end of the table -->'


def write_study(study: Study, jobs: Sequence[Job], output: Path, command: str) -> None:
    """Writes what the finished jobs of a study gave.

    `runs.csv` (one row per run), `arms.csv` (medians and quartiles), `curves.csv` (every
    evaluation), `study.json` (command, machine, revisions, settings), `figure.png`, and the table
    between its marks in `README.md`, which is made where there is none.

    Args:
        study: The study.
        jobs: Finished jobs.
        output: Folder.
        command: Command line, for the record.
    """
    output.mkdir(parents=True, exist_ok=True)
    found = [curve_of(job) for job in jobs]
    runs = [measure_run(job, curve) for job, curve in zip(jobs, found, strict=True)]
    groups, curves = by_arm(jobs, runs), by_arm(jobs, found)
    order = [arm.name for arm in study.arms]
    arms = [sum_up(groups[task][name]) for task in groups for name in order if name in groups[task]]
    _write_csv(runs, output / 'runs.csv')
    _write_csv(arms, output / 'arms.csv')
    write_curves(jobs, found, output / 'curves.csv')
    (output / 'study.json').write_text(json.dumps(_about(study, jobs, command), indent=2) + '\n')
    labels = {arm.name: arm.label for arm in study.arms}
    bands = {
        task: {name: aggregate(group[name]) for name in order if name in group}
        for task, group in curves.items()
    }
    draw(bands, labels, output / 'figure.png', paper_epochs=False)
    _renew(output / 'README.md', format_table(study, arms))


def format_table(study: Study, arms: Sequence[Mapping[str, Any]]) -> str:
    """The Markdown table of a study: an arm per row, its quartiles beside each median."""
    labels = {arm.name: arm.label for arm in study.arms}
    lines = [
        f'| task | arm | seeds | area | steps to {GOOD_SUCCESS} (reached) | final success '
        '| processor time, s | samples per s | against the baseline |',
        '| --- | --- | --- | --- | --- | --- | --- | --- | --- |',
    ]
    for row in arms:
        steps = row[f'steps_to_{GOOD_SUCCESS}_median']
        cells = [
            row['task'],
            f'`{row["arm"]}`: {labels[row["arm"]]}',
            str(row['seeds']),
            _quartiles(row, 'area'),
            f'{steps:,} ({row["reached"]})' if steps != '' else f'censored ({row["reached"]})',
            _quartiles(row, 'final_success'),
            f'{row["processor_seconds_median"]:.0f}',
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
    for name, label in (('area', 'area'), ('final_success', 'final')):
        if are_apart(row, found[0], name):
            better = row[f'{name}_median'] > found[0][f'{name}_median']
            words.append(f'{label} {"better" if better else "worse"}')
    return ', '.join(words) or 'not apart'


def _quartiles(row: Mapping[str, Any], name: str) -> str:
    values = (row[f'{name}_{part}'] for part in ('median', 'lower', 'upper'))
    return '{:.3f} ({:.3f} ... {:.3f})'.format(*values)


def _about(study: Study, jobs: Sequence[Job], command: str) -> dict[str, Any]:
    return {
        'study': study.name,
        'request': study.request,
        'question': study.question,
        'command': command,
        'source_revisions': source_revisions(jobs),
        'machine': machine(),
        'settings': _shared_settings(study, jobs),
        'arms': {arm.name: dict(arm.changes) for arm in study.arms},
    }


def _shared_settings(study: Study, jobs: Sequence[Job]) -> dict[str, dict[str, Any]]:
    """By task, the fields of `TrainConfig` that all arms share."""
    own = {'seed', *(name for arm in study.arms for name in arm.changes)}
    if 'control_hz' in own:
        own |= set(STEP_COUNTS)
    configs = {job.config.task: dataclasses.asdict(job.config) for job in jobs}
    return {
        task: {name: value for name, value in config.items() if name not in own}
        for task, config in configs.items()
    }


def _write_csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    with path.open('w', newline='') as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)


def _renew(page: Path, table: str) -> None:
    """Puts the table between its marks."""
    text = page.read_text() if page.is_file() else f'{BEGIN}\n{END}\n'
    if BEGIN in text and END in text:
        before, after = text.split(BEGIN)[0], text.split(END, 1)[1]
        page.write_text(f'{before}{BEGIN}\n{table}{END}{after}')
