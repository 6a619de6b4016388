"""A study: its question, its variants, its budget and its training runs.

All variants of a study share tasks and settings and differ only in `changes` and `factors`. On one
thread, runs with equal seeds give bit-identical results.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import (
    changed,
    config_from_dict,
    removed_fields,
    to_flat,
)
from policy_node.training.configuration.recipes import recipe_config, steps_at_rate
from policy_node.training.runs.run_folder import PROGRESS_FILE, STATE_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import read_counters, read_state

FINAL_EPISODES = 500
"""Fresh episodes that measure the final success of a run."""

# Make runs repeatable, and one core enough for a run.
REPEATABLE: dict[str, Any] = {
    'simulation_threads': 1,
    'torch_threads': 1,
    'precision': 'float32',
    'overlap': False,
}

# Fields that do not change the result. The start networks are read once, and their path depends on
# the working directory.
_MAY_DIFFER = (
    'simulation_threads',
    'torch_threads',
    'checkpoint_seconds',
    'kept_transitions',
    'device',
    'init_from',
)


@dataclass(frozen=True, slots=True)
class Arm:
    """One variant of a study: one curve in its figure.

    Attributes:
        name: Name in folders and on the command line.
        label: Name in figures and tables.
        changes: Fields of `TrainConfig` that only this variant sets.
        factors: Integer fields, and the factor by which this variant multiplies their common value.
        after: Variant that trains the initial networks, with the same task and seed; empty if none.
        tasks: Tasks of this variant; empty for all tasks of the study.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    factors: Mapping[str, int] = field(default_factory=dict)
    after: str = ''
    tasks: tuple[str, ...] = ()

    @property
    def own(self) -> set[str]:
        """Names of the fields in `changes` and `factors`."""
        return {*self.changes, *self.factors}


@dataclass(frozen=True, slots=True)
class Start:
    """Trained networks from which the runs of a task start.

    Attributes:
        task: Task of the study whose run with the same seed trains them.
        fields: Fields of `TrainConfig` for the runs that start from them.
        arm: Variant of that run; empty for the variant of the run that starts from them.
    """

    task: str
    fields: Mapping[str, Any]
    arm: str = ''


@dataclass(frozen=True, slots=True)
class Study:
    """One question, its variants and its budget.

    Attributes:
        name: Name of the folder and on the command line.
        request: Number of the request in the second part of Plappert et al. 2018, or None.
        question: The question in one sentence.
        settings: Fields of `TrainConfig` for all variants, by task; the first task is the default.
            They replace fields of the recipe `best`, or of the recipe that they name.
        arms: The variants; the first is the baseline.
        seeds: Default number of seeds.
        starts: Networks that the runs of a task start from, by task. If the task that trains them
            is not selected, they are those of its shipped policy.
        ships: Whether the study selects actors to ship, instead of comparing variants. The better
            of best and latest actor of each last stage is copied if it beats the shipped one.
    """

    name: str
    request: int | None
    question: str
    settings: Mapping[str, Mapping[str, Any]]
    arms: tuple[Arm, ...]
    seeds: int = 5
    starts: Mapping[str, Start] = field(default_factory=dict)
    ships: bool = False

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that the study has settings for."""
        return tuple(self.settings)

    @property
    def output(self) -> Path:
        """Default folder of the runs."""
        return Path('runs') / ('' if self.ships else 'research') / self.name

    def arm(self, name: str) -> Arm:
        """Return the variant with this name.

        Raises:
            ValueError: If the name is unknown.
        """
        arms = {arm.name: arm for arm in self.arms}
        if name not in arms:
            raise ValueError(f'--arms {name!r}; allowed in {self.name}: {", ".join(arms)}')
        return arms[name]

    def jobs(
        self,
        tasks: Sequence[str],
        arms: Sequence[Arm],
        seeds: Sequence[int],
        overrides: Mapping[str, Any],
        output: Path,
        episodes: int = FINAL_EPISODES,
    ) -> list[Job]:
        """Return the jobs, sorted by task, then seed, then variant.

        So a study that is stopped early has about equally many runs of each variant. A job that
        trains the initial networks of another comes before it, also if its variant is not in
        `arms`. Step counts are scaled with the action frequency, so that all runs have equal
        simulated time.

        Args:
            overrides: Fields of `TrainConfig` for all runs; `changes` of a variant replace them.
            output: Folder of all runs.
            episodes: Fresh episodes that measure the last actor of each run.

        Raises:
            ValueError: If a task or value is not allowed, or if no variant is for these tasks.
        """
        self._require_tasks(tasks)
        jobs: dict[tuple[str, str, int], Job] = {}
        begun: set[tuple[str, str, int]] = set()

        def add(task: str, arm: Arm, seed: int) -> Job:
            key = task, arm.name, seed
            if key in jobs:
                return jobs[key]
            if key in begun:
                raise ValueError(f'{task}/{arm.name} starts from its own networks')
            begun.add(key)
            before, given = None, {}
            if start := Start(task, {}, arm.after) if arm.after else self.starts.get(task):
                if start.task in tasks:
                    before = add(start.task, self.arm(start.arm) if start.arm else arm, seed)
                # The name of a task stands for its shipped policy.
                given = {**start.fields, 'init_from': str(before.folder) if before else start.task}
            config = self._config(task, arm, {**given, **overrides, **arm.changes, 'seed': seed})
            folder = output / task / arm.name / f'seed{seed}'
            jobs[key] = Job(arm, config, folder, before, episodes)
            return jobs[key]

        for task in (name for name in self.tasks if name in tasks):
            of_task = [arm for arm in arms if not arm.tasks or task in arm.tasks]
            for seed, arm in product(seeds, of_task):
                add(task, arm, seed)
        if not jobs:
            allowed = ', '.join(dict.fromkeys(task for arm in arms for task in arm.tasks))
            names = ', '.join(arm.name for arm in arms)
            raise ValueError(f'--tasks {", ".join(tasks)}; allowed with --arms {names}: {allowed}')
        return list(jobs.values())

    def _require_tasks(self, tasks: Sequence[str]) -> None:
        """Raise ValueError if the study has no settings for a task."""
        for task in tasks:
            if task not in self.settings:
                raise ValueError(f'--tasks {task}; allowed in {self.name}: {", ".join(self.tasks)}')

    def _config(self, task: str, arm: Arm, fields: Mapping[str, Any]) -> TrainConfig:
        """Return the settings of the task with `fields` replaced, at the rate of the run."""
        values = {'recipe': 'best', **REPEATABLE, **self.settings[task], **fields}
        rate = values.get('control_hz', DEFAULT_CONTROL_HZ)
        config = recipe_config(task, **{**values, **steps_at_rate(values, rate)})
        for name in ('time_limit', 'success_target'):
            if getattr(config, name):
                raise ValueError(f'{task}/{arm.name} has {name}; jobs end when steps are done')
        if config.algorithm == 'imitation':
            # Their runs have no training state, so no job of a study would ever be finished.
            raise ValueError(f'{task}/{arm.name} has algorithm imitation; studies cannot run it')
        # `changed` rejects unknown fields.
        factors = {name: to_flat(config).get(name, 0) * by for name, by in arm.factors.items()}
        return changed(config, **factors)


@dataclass(frozen=True, slots=True)
class Job:
    """One training run.

    Attributes:
        arm: The variant.
        config: The whole configuration.
        folder: Output folder of the training.
        after: The job that trains the initial networks of this one, or None.
        final_episodes: Fresh episodes that measure the last actor; 0 measures nothing.
    """

    arm: Arm
    config: TrainConfig
    folder: Path
    after: Job | None = None
    final_episodes: int = 0

    @property
    def key(self) -> tuple[str, str, int]:
        """Task, variant and seed, which identify the job."""
        return self.config.task, self.arm.name, self.config.seed

    @property
    def name(self) -> str:
        """Path `<task>/<variant>/seed<seed>` of the folder, within the folder of all runs."""
        return f'{self.config.task}/{self.arm.name}/seed{self.config.seed}'

    @property
    def has_checkpoint(self) -> bool:
        """True if the folder contains a training state from which to continue."""
        return (self.folder / STATE_FILE).is_file()

    @property
    def is_trained(self) -> bool:
        """True if the training state in the folder has reached the configured number of steps."""
        if not self.has_checkpoint:
            return False
        return read_counters(self.folder / STATE_FILE).env_steps >= self.config.total_steps

    @property
    def is_ready(self) -> bool:
        """True if the job can start: `after` is None or trained, or this job has begun."""
        return self.after is None or self.has_checkpoint or self.after.is_trained

    @property
    def status(self) -> str:
        """One line with name, steps, success in the last evaluation and remaining time."""
        log, total = self.folder / PROGRESS_FILE, self.config.total_steps
        rows = read_progress(log) if log.is_file() else []
        evaluated = [row['eval_success'] for row in rows if 'eval_success' in row]
        success = f'{evaluated[-1]:.3f}' if evaluated else '-'
        last = rows[-1] if rows else {}
        steps, speed = last.get('env_steps', 0.0), last.get('steps_per_second', 0.0)
        left = f'{(total - steps) / speed / 3600:.1f} h' if speed else '-'
        return f'{self.name}: {steps:,.0f} of {total:,} steps, eval {success}, ETA {left}'

    def check_configuration(self) -> None:
        """Raise ValueError if the folder contains a run with another configuration.

        Fields that do not change the result may differ. A damaged training state raises ValueError.
        """
        if not self.has_checkpoint:
            return
        try:
            stored = read_state(self.folder / STATE_FILE).extra['config']
        except ValueError as error:
            raise ValueError(f'{error}. Remove {self.folder} to train it again.') from None
        if differing := differing_fields(stored, self.config):
            raise ValueError(
                f'{self.folder} contains a run with {"; ".join(differing.values())}. '
                'Choose another --output.'
            )


def to_settings(config: TrainConfig) -> dict[str, Any]:
    """Convert a configuration to JSON values, one per field."""
    values: dict[str, Any] = json.loads(json.dumps(to_flat(config)))
    return values


def differing_fields(stored: Mapping[str, Any], config: TrainConfig) -> dict[str, str]:
    """Return a text with both values for each field that differs and changes the result.

    Args:
        stored: A configuration from `to_settings`; missing fields have their default.
        config: The configuration to compare with.

    Raises:
        ValueError: If the stored configuration has unknown fields or invalid values.
    """
    before, now = to_settings(config_from_dict(dict(stored))), to_settings(config)
    removed = {n: f'{n} {value!r}, now removed' for n, value in removed_fields(stored).items()}
    return removed | {
        name: f'{name} {value!r}, now {now[name]!r}'
        for name, value in before.items()
        if value != now[name] and name not in _MAY_DIFFER
    }
