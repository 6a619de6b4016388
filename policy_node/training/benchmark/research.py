"""The studies of the paper's nine requests for research: what each compares, as data.

All arms of a study share task, budget and settings and differ in `changes` alone. Settings are the
`best` recipe but for what is named here. Every run is one of `train_her`: on one thread it gives
the same bits from the same seed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from policy_node.training.benchmark.jobs import Arm, Job
from policy_node.training.learning.config import recipe_config

# Fresh episodes behind the final success of a run.
FINAL_EPISODES = 500
# What makes runs repeatable on any processor, and one core enough for a run.
_SHARED: dict[str, Any] = {
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
        request: Number of the request in the second part of Plappert et al. 2018.
        question: What it asks.
        settings: Fields of `TrainConfig` for all arms, by task; the first task is the default.
        arms: What is compared; the first is the baseline.
        seeds: How many by default.
    """

    name: str
    request: int
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


# FetchReach in cycles of 16 episodes, so that its first thousands of steps can be told apart.
_REACH = {
    'num_envs': 16,
    'updates_per_cycle': 40,
    'batch_size': 256,
    'total_steps': 16_000,
    'evaluate_every': 1_600,
    'evaluation_episodes': 32,
}
_PUSH = {'total_steps': 600_000, 'evaluate_every': 19_200, 'evaluation_episodes': 64}

STUDIES: dict[str, Study] = {
    study.name: study
    for study in (
        Study(
            'unbiased',
            2,
            'Does hindsight take a gamble for a sure thing, and what cures it?',
            {
                'FetchReach': {**_REACH, 'gamble': True},
                'FetchPush': {**_PUSH, 'gamble': True},
            },
            (
                Arm('future', 'future goals', {'strategy': 'future'}),
                Arm('none', 'no hindsight', {'strategy': 'none'}),
                Arm('actual', 'desired goals of any episode', {'goals': 'actual=.8'}),
                Arm('random', 'achieved goals of any episode', {'goals': 'random=.8'}),
                Arm('mixed', 'half future, half actual', {'goals': 'future=.4,actual=.4'}),
                Arm(
                    'weighted',
                    'the same with importance weights',
                    {'goals': 'future=.4,actual=.4', 'importance': 'density'},
                ),
            ),
        ),
    )
}


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
        shared = {**_SHARED, **study.settings[task], **overrides}
        for seed in seeds:
            for arm in arms:
                config = recipe_config(task, 'best', **{**shared, **arm.changes, 'seed': seed})
                folder = output / task / arm.name / f'seed{seed}'
                jobs.append(Job(arm, config, folder, final_episodes=episodes))
    return jobs
