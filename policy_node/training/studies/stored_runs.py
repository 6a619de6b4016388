"""What a report under `docs/research` holds of a study: its runs, from any day and machine.

`runs.csv` has a row per run, `curves.csv` every evaluation, and `study.json` how each arm was
configured; runs that were configured otherwise are not put beside them.
"""

from __future__ import annotations

import csv
import dataclasses
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from node_runtime.command_line import complain
from policy_node.policies.files import to_json
from policy_node.training.configuration.config_values import config_from_dict
from policy_node.training.configuration.recipes import STEP_COUNTS
from policy_node.training.studies.jobs import Job, differing_runs, run_name
from policy_node.training.studies.measures import MEASURED, curve_of, measure_run
from policy_node.training.studies.results import curve_rows, to_csv
from policy_node.training.studies.study import Study

RUNS, CURVES, ABOUT = 'runs.csv', 'curves.csv', 'study.json'
RUN = ('task', 'arm', 'seed')
"""Columns that name a run."""

Rows = list[dict[str, Any]]

# Columns that a report reckons with; others may be empty.
_NUMBERS = {
    RUNS: (
        'seed',
        'simulated_seconds',
        'area',
        'final_success',
        'final_episodes',
        'processor_seconds',
        'samples_per_processor_second',
    ),
    CURVES: ('seed', 'env_steps', 'success'),
}
# What there is once in a file.
_NAMES = {RUNS: RUN, CURVES: (*RUN, 'env_steps')}


@dataclass(slots=True)
class StoredRuns:
    """The runs of a study that a folder holds, and those that are put beside them.

    Attributes:
        folder: The report.
        runs: Rows of `runs.csv`.
        curves: Rows of `curves.csv`.
        tasks: By task: the `commands` that ran, the `settings` that all its arms share, and `arms`,
            by name the fields that are an arm's own. Both together are a whole configuration.
    """

    folder: Path
    runs: Rows
    curves: Rows
    tasks: dict[str, dict[str, Any]]

    @classmethod
    def read(cls, folder: Path) -> StoredRuns:
        """Reads a report; one that is not there holds nothing.

        Evaluations of runs that `runs.csv` does not have are left out, and a line says so.

        Raises:
            ValueError: If a file cannot be read, tells of something twice, or does not fit another.
        """
        stored = cls(
            folder,
            read_rows(folder / RUNS),
            read_rows(folder / CURVES),
            _read_tasks(folder / ABOUT),
        )
        for name, rows in ((RUNS, stored.runs), (CURVES, stored.curves)):
            _require_numbers(rows, folder / name, _NUMBERS[name])
            _require_once(rows, folder / name, _NAMES[name])
        stored._leave_out_unknown()
        evaluated = {run_of(row, folder / CURVES) for row in stored.curves}
        for row in stored.runs:
            task, arm, _ = run = run_of(row, folder / RUNS)
            if run not in evaluated:
                raise ValueError(f'{folder / CURVES} has no evaluation of {run_name(*run)}')
            if arm not in stored.tasks.get(task, {'arms': {}})['arms']:
                raise ValueError(f'{folder / ABOUT} has no settings of {run_name(*run)}')
        stored._require_settings()
        return stored

    def _leave_out_unknown(self) -> None:
        """Leaves out evaluations of runs that are not there, which a figure would show."""
        known = {run_of(row, self.folder / RUNS) for row in self.runs}
        unknown = {run_of(row, self.folder / CURVES) for row in self.curves} - known
        if unknown:
            names = ', '.join(sorted(run_name(*run) for run in unknown))
            line = f'{self.folder / RUNS} has no {names:.200}; their evaluations are left out'
            complain('benchmark', line)
            self.curves = [row for row in self.curves if run_of(row) not in unknown]

    def _require_settings(self) -> None:
        """Refuses settings that are no configuration."""
        for task, told in self.tasks.items():
            for arm in told['arms']:
                try:
                    config_from_dict(self.configuration(task, arm))
                except (TypeError, ValueError) as error:
                    raise ValueError(f'{self.folder / ABOUT}, {task}/{arm}: {error}') from None

    def holds(self, job: Job) -> bool:
        """Whether it has a run of the job's name, measured on as many episodes."""
        wanted = (*_name_of(job), job.final_episodes)
        return any((*run_of(row), row['final_episodes']) == wanted for row in self.runs)

    def configuration(self, task: str, arm: str) -> dict[str, Any]:
        """Fields of `TrainConfig` of an arm, without the seed."""
        told = self.tasks[task]
        return {**told['settings'], **told['arms'][arm]}

    def require_alike(self, study: Study, jobs: Sequence[Job]) -> None:
        """Refuses jobs that are configured otherwise than what they would stand beside.

        Raises:
            ValueError: The line names one run and its fields.
        """
        own = own_fields(study)
        for job in {(job.config.task, job.arm.name): job for job in jobs}.values():
            task = job.config.task
            for arm in self.tasks.get(task, {'arms': ()})['arms']:
                stored = self._configured(task, arm, job)
                differing = differing_runs(stored, job.config)
                if arm != job.arm.name:
                    differing = {name: text for name, text in differing.items() if name not in own}
                if differing:
                    raise ValueError(
                        f'{self.folder} holds runs of {task}/{arm} with '
                        f'{"; ".join(differing.values())}: name another folder with --report'
                    )

    def equal_run(self, job: Job) -> dict[str, Any] | None:
        """Row of a run, of whatever arm, that is configured and measured as a job; None."""
        for row in self.runs:
            task, arm, seed = run_of(row)
            wanted = (job.config.task, job.config.seed, job.final_episodes)
            if (task, seed, row['final_episodes']) != wanted:
                continue
            if not differing_runs(self._configured(task, arm, job), job.config):
                return row
        return None

    def _configured(self, task: str, arm: str, job: Job) -> dict[str, Any]:
        return {**self.configuration(task, arm), 'seed': job.config.seed}

    def add(self, jobs: Sequence[Job], command: str) -> None:
        """Puts finished jobs beside what is there; what is there of the same name goes.

        Args:
            jobs: Finished jobs.
            command: Command line, for the record.
        """
        for job in jobs:
            curve = curve_of(job)
            self.put(job, measure_run(job, curve), curve_rows([job], [curve]), command)

    def put(self, job: Job, run: Mapping[str, Any], curve: Rows, command: str) -> None:
        """Puts one run there.

        Args:
            job: Whose task, arm, seed and configuration it has.
            run: Its row of `runs.csv`.
            curve: Its rows of `curves.csv`.
            command: Command line, for the record.
        """
        name = dict(zip(RUN, _name_of(job), strict=True))
        self.runs = [row for row in self.runs if run_of(row) != _name_of(job)]
        self.curves = [row for row in self.curves if run_of(row) != _name_of(job)]
        self.runs.append({**run, **name})
        self.curves += [{**row, **name} for row in curve]
        self._tell(job, command)

    def _tell(self, job: Job, command: str) -> None:
        """Notes how an arm is configured, in what all arms share and what is its own."""
        task = job.config.task
        told = self.tasks.setdefault(task, {'commands': [], 'settings': {}, 'arms': {}})
        if command not in told['commands']:
            told['commands'].append(command)
        configurations = {arm: self.configuration(task, arm) for arm in told['arms']}
        values = json.loads(json.dumps(dataclasses.asdict(job.config)))
        configurations[job.arm.name] = {k: v for k, v in values.items() if k != 'seed'}
        told['settings'], told['arms'] = _split(configurations)

    def files(self, study: Study) -> dict[Path, bytes]:
        """What the three files hold then, in the order of the study's tasks and arms."""
        self._sort(study)
        about = {
            'study': study.name,
            'request': study.request,
            'question': study.question,
            'tasks': self.tasks,
        }
        runs = [_in_order(row) for row in self.runs]
        # The runs last: what is of none of them is left out by who reads.
        contents = {ABOUT: to_json(about), CURVES: to_csv(self.curves), RUNS: to_csv(runs)}
        return {self.folder / name: content for name, content in contents.items()}

    def _sort(self, study: Study) -> None:
        tasks, arms = list(study.tasks), [arm.name for arm in study.arms]

        def place(row: Mapping[str, Any]) -> tuple[int, int, int]:
            task, arm, seed = run_of(row)
            return _index(tasks, task), seed, _index(arms, arm)

        self.runs.sort(key=place)
        self.curves.sort(key=place)
        self.tasks = dict(sorted(self.tasks.items(), key=lambda item: _index(tasks, item[0])))
        for told in self.tasks.values():
            ordered = sorted(told['arms'].items(), key=lambda item: _index(arms, item[0]))
            told['arms'] = dict(ordered)


def _in_order(run: Mapping[str, Any]) -> dict[str, Any]:
    """A row of `runs.csv` with the columns of `MEASURED` first."""
    return {name: run.get(name, '') for name in MEASURED} | dict(run)


def own_fields(study: Study) -> set[str]:
    """Fields in which arms of a study may differ."""
    own = {name for arm in study.arms for name in arm.own}
    return own | set(STEP_COUNTS) if 'control_hz' in own else own


def run_of(row: Mapping[str, Any], path: Path | None = None) -> tuple[str, str, int]:
    """Task, arm and seed of a row.

    Raises:
        ValueError: If it has not all three; the line names the file.
    """
    try:
        task, arm, seed = (row[name] for name in RUN)
    except KeyError as error:
        raise ValueError(f'{path} has no column {error}') from None
    return task, arm, seed


def _require_numbers(rows: Rows, path: Path, names: Sequence[str]) -> None:
    """Refuses rows that were cut or edited into something else.

    Raises:
        ValueError: The line names file, line and column.
    """
    for line, row in enumerate(rows, 2):
        if None in row:
            raise ValueError(f'{path}, line {line}, has more cells than there are columns')
        for name in names:
            if name not in row:
                raise ValueError(f'{path} has no column {name!r}')
            value = row[name]
            if isinstance(value, str) or not math.isfinite(value):
                raise ValueError(f'{path}, line {line}: {name} {value!r} is no number')
        if not isinstance(row['seed'], int):
            raise ValueError(f'{path}, line {line}: seed {row["seed"]} is no whole number')


def _require_once(rows: Rows, path: Path, names: Sequence[str]) -> None:
    """Refuses what is told twice, as two versions of a file put together tell it.

    Raises:
        ValueError: The line names file, line and what there is twice.
    """
    seen = set()
    for line, row in enumerate(rows, 2):
        what = tuple(row.get(name) for name in names)
        if what in seen:
            raise ValueError(f'{path}, line {line}: {"/".join(map(str, what))} is there twice')
        seen.add(what)


def read_rows(path: Path) -> Rows:
    """Rows of a CSV file, numbers as numbers; none where there is no file.

    Raises:
        ValueError: If it cannot be read.
    """
    if not path.is_file():
        return []
    try:
        # Spreadsheets begin a file with a mark of its encoding.
        rows = list(csv.DictReader(path.read_text(encoding='utf-8-sig').splitlines()))
    except OSError as error:
        raise ValueError(f'{path} cannot be read: {error.strerror}') from None
    except (ValueError, csv.Error) as error:
        raise ValueError(f'{path} is no table: {error}') from None
    return [{name: _value(text) for name, text in row.items()} for row in rows]


def _read_tasks(path: Path) -> dict[str, dict[str, Any]]:
    try:
        tasks = dict(json.loads(path.read_text())['tasks']) if path.is_file() else {}
        for told in tasks.values():
            told['commands'], told['settings'], told['arms'].items()
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ValueError(f'{path} is no record of a study: {error!r}') from None
    return tasks


def _value(text: str | list[str] | None) -> int | float | str:
    # The cells of a row that is too long are a list, those of one too short None.
    if not isinstance(text, str):
        return ''
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _split(
    configurations: Mapping[str, Mapping[str, Any]],
) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Configurations of arms as what all share and what each has besides."""
    first, *others = configurations.values()
    shared = {
        name: value
        for name, value in first.items()
        if all(name in other and other[name] == value for other in others)
    }
    own = {
        arm: {name: value for name, value in values.items() if name not in shared}
        for arm, values in configurations.items()
    }
    return shared, own


def _index(names: Sequence[str], name: str) -> int:
    """Place of a name; behind all where it is none of them."""
    return names.index(name) if name in names else len(names)


def _name_of(job: Job) -> tuple[str, str, int]:
    return job.config.task, job.arm.name, job.config.seed
