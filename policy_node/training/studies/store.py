"""The finished runs of a study, one JSON object per line in `runs.jsonl` of its report folder.

Lines are only added. If two lines describe the same run, the later one counts. Tables and figures
are derived from this file.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies.files import write_file
from policy_node.training.configuration.recipes import STEP_COUNTS
from policy_node.training.studies.study import Job, Study, differing_fields

RUNS = 'runs.jsonl'

Run = dict[str, Any]
"""A line of `runs.jsonl`: `task`, `arm`, `seed`, measures, `curve`, `command` and `config`."""
Runs = dict[tuple[str, str, int], Run]
"""Runs by task, variant and seed."""


def read_runs(folder: Path) -> Runs:
    """Return the runs of a report folder by task, variant and seed; empty without `runs.jsonl`.

    Raises:
        ValueError: If a line of the file is no run.
    """
    runs: Runs = {}
    file = folder / RUNS
    if not file.is_file():
        return runs
    for number, line in enumerate(file.read_text(errors='replace').splitlines(), 1):
        try:
            run = json.loads(line)
            runs[run['task'], run['arm'], run['seed']] = run
        except (ValueError, KeyError, TypeError):
            raise ValueError(
                f'{file}, line {number}, is no run. Remove the line; the run is measured again.'
            ) from None
    return runs


def add_run(folder: Path, run: Mapping[str, Any]) -> None:
    """Append a run to `runs.jsonl` of a report folder; after an OSError the file is unchanged."""
    file, line = folder / RUNS, json.dumps(run, separators=(',', ':'))
    with alone_in(folder):
        stored = file.read_bytes() if file.is_file() else b''
        if stored and not stored.endswith(b'\n'):
            # An editor may leave the last line without its end.
            stored += b'\n'
        write_file(file, stored + line.encode() + b'\n')


def in_order(runs: Iterable[Run], study: Study) -> list[Run]:
    """Sort runs by task, seed and variant; tasks and variants keep the order of the study."""
    tasks = {name: index for index, name in enumerate(study.tasks)}
    arms = {arm.name: index for index, arm in enumerate(study.arms)}

    def place(run: Run) -> tuple[int, int, int]:
        return tasks.get(run['task'], len(tasks)), run['seed'], arms.get(run['arm'], len(arms))

    return sorted(runs, key=place)


def holds(runs: Runs, job: Job) -> bool:
    """Return whether `runs` has a run of `job` with equal configuration and `final_episodes`."""
    run = runs.get(job.key)
    if run is None or run['final_episodes'] != job.final_episodes:
        return False
    return not differing_fields(run['config'], job.config)


def own_fields(study: Study) -> set[str]:
    """Return the fields in which variants of a study may differ."""
    own = {name for arm in study.arms for name in arm.own}
    if any(arm.after for arm in study.arms):
        # A second stage has other networks than the first, and no fields of a start.
        own |= {'init_from', *(name for start in study.starts.values() for name in start.fields)}
    return own | set(STEP_COUNTS) if 'control_hz' in own else own


def require_alike(study: Study, jobs: Sequence[Job], folder: Path) -> None:
    """Check that jobs and the stored runs of the same task have equal configurations.

    Between different variants, the fields of `own_fields` may differ.

    Raises:
        ValueError: If they differ; the message names one stored run and the fields.
    """
    own = own_fields(study)
    examples = {(run['task'], run['arm']): run for run in read_runs(folder).values()}
    for job in {job.key[:2]: job for job in jobs}.values():
        for (task, arm), run in examples.items():
            if task != job.config.task:
                continue
            stored, start = {**run['config'], 'seed': job.config.seed}, job.config.init_from
            differing = differing_fields(stored, job.config)
            # A shipped policy counts, too; the folder of another job depends on variant and seed.
            if job.after is None and (before := stored.get('init_from', '')) != start:
                differing['init_from'] = f'init_from {before!r}, now {start!r}'
            if arm != job.arm.name:
                differing = {name: text for name, text in differing.items() if name not in own}
            if differing:
                raise ValueError(
                    f'{folder} contains runs of {task}/{arm} with '
                    f'{"; ".join(differing.values())}. Choose another --report.'
                )
