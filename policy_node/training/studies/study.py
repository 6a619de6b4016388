"""A study: a question, its arms and its budget, and the jobs that this makes.

All arms of a study share task, budget and settings and differ in `changes` alone. Every run is one
of `train_her`: on one thread it gives the same bits from the same seed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from policy_node.training.configuration.recipes import recipe_config, steps_at_rate
from policy_node.training.studies.jobs import Arm, Job

# Fresh episodes behind the final success of a run.
FINAL_EPISODES = 500
# What makes runs repeatable, and one core enough for a run.
REPEATABLE: dict[str, Any] = {
    'simulation_threads': 1,
    'torch_threads': 1,
    'precision': 'float32',
    'overlap': False,
}


@dataclass(frozen=True, slots=True)
class Study:
    """One question, its arms and its budget.

    Attributes:
        name: Name of the folder and of the command-line option.
        request: Number of the request in the second part of Plappert et al. 2018; None if it
            answers none of them.
        question: What it asks.
        settings: Fields of `TrainConfig` for all arms, by task; the first task is the default.
            They replace those of the recipe `best`, or of the one that they name as `recipe`.
        arms: What is compared; the first is the baseline.
        seeds: How many by default.
    """

    name: str
    request: int | None
    question: str
    settings: Mapping[str, Mapping[str, Any]]
    arms: tuple[Arm, ...]
    seeds: int = 5

    @property
    def tasks(self) -> tuple[str, ...]:
        """The tasks that it has settings for."""
        return tuple(self.settings)

    def arm(self, name: str) -> Arm:
        """Returns an arm.

        Raises:
            ValueError: If there is none of this name.
        """
        arms = {arm.name: arm for arm in self.arms}
        if name not in arms:
            raise ValueError(f'--arms {name!r}; allowed in {self.name}: {", ".join(arms)}')
        return arms[name]


def _at_rate(values: dict[str, Any]) -> dict[str, Any]:
    """Fields of a configuration with step counts at its rate: equal budgets in simulated time."""
    return {**values, **steps_at_rate(values, values.get('control_hz', DEFAULT_CONTROL_HZ))}


def research_jobs(
    study: Study,
    tasks: Sequence[str],
    arms: Sequence[Arm],
    seeds: Sequence[int],
    overrides: Mapping[str, Any],
    output: Path,
    episodes: int = FINAL_EPISODES,
) -> list[Job]:
    """Task x seed x arm, seed by seed, so that an early stop leaves all arms with as many seeds.

    Args:
        study: The study.
        tasks: Some of its tasks.
        arms: Some of its arms.
        seeds: Seeds.
        overrides: Fields of `TrainConfig` for all jobs; what the arms differ in is theirs.
        output: Folder for all runs.
        episodes: Fresh episodes behind the final success of each.

    Raises:
        ValueError: If a task or a value is not allowed.
    """
    jobs = []
    for task in tasks:
        if task not in study.settings:
            raise ValueError(f'--tasks {task}; allowed in {study.name}: {", ".join(study.tasks)}')
        shared = {'recipe': 'best', **REPEATABLE, **study.settings[task], **overrides}
        for seed in seeds:
            for arm in arms:
                values = _at_rate({**shared, **arm.changes, 'seed': seed})
                config = recipe_config(task, **values)
                more = {name: getattr(config, name) * by for name, by in arm.factors.items()}
                config = dataclasses.replace(config, **more)
                folder = output / task / arm.name / f'seed{seed}'
                jobs.append(Job(arm, config, folder, final_episodes=episodes))
    return jobs
