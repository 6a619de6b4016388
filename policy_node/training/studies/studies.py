"""What `paper` and `best` train: four arms, or the best recipe of every task."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS, task_spec
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.studies.jobs import ARMS, BEST_ARM, Job
from policy_node.training.studies.research import HAND
from policy_node.training.studies.study import Study

# The long ones first. What XYZ has learnt of turning a block serves every other task of the block;
# likewise the egg and the pen.
BEST_ORDER = (
    'HandManipulateBlockRotateXYZ',
    'HandManipulateEggRotate',
    'HandManipulatePenRotate',
    'HandManipulateBlockFull',
    'HandManipulateEggFull',
    'HandManipulatePenFull',
    'HandManipulateBlockRotateParallel',
    'HandManipulateBlockRotateZ',
    'FetchSlide',
    'HandReach',
    'FetchPickAndPlace',
    'FetchPush',
    'FetchReach',
)
STARTS_FROM = {
    'HandManipulateBlockRotateParallel': 'HandManipulateBlockRotateXYZ',
    'HandManipulateBlockRotateZ': 'HandManipulateBlockRotateParallel',
    'HandManipulateBlockFull': 'HandManipulateBlockRotateXYZ',
    'HandManipulateEggFull': 'HandManipulateEggRotate',
    'HandManipulatePenFull': 'HandManipulatePenRotate',
}
# What keeps what the networks know already: a full replay before the first update, smaller steps,
# less noise; and where goals gain a position, goals that are coarse at first (docs/training.md).
_FINE_TUNING = {
    'learning_starts': 100_000,
    'learning_rate': 5e-4,
    'noise_std': 0.15,
    'random_epsilon': 0.2,
}
_COARSE_FIRST = {'first_distance': 8.0}
# A pen is dropped by most noise, and a drop that counts as final teaches to hold it only while some
# goals are met besides.
_HELD = {
    'learning_starts': 64_000,
    'noise_std': 0.1,
    'random_epsilon': 0.1,
    'ticks_after_drop': 3,
    'drop_is_lost': True,
    'first_rotation': 3.0,
    'first_distance': 2.0,
}


def start_from(task: str, networks: str) -> dict[str, Any]:
    """Fields of a run that starts from the networks of the task named in `STARTS_FROM`."""
    coarse = _COARSE_FIRST if task_spec(task).position_counts else {}
    held = _HELD if 'Pen' in task else {}
    return {**_FINE_TUNING, **coarse, **held, 'init_from': networks}


def reduced_budget(task: str) -> dict[str, Any]:
    """What makes the `paper` recipe fit one machine; everything else stays as in the paper.

    Two collections of 38 episodes are one, with twice the updates. Steps are 1.2 % (FetchReach) or
    12 % of the paper's; batches 256 or 1024 instead of 4864; to learn in so few updates, targets
    move after every 10 of them instead of 40.
    """
    small = task == 'FetchReach'
    full = recipe_config(task, 'paper').total_steps
    return {
        'total_steps': full * 12 // (1000 if small else 100),
        'num_envs': 76,
        'updates_per_cycle': 80,
        'batch_size': 256 if small else 1024,
        'target_update_interval': 10,
        'replay_transitions': 1_000_000,
        'evaluate_every': 3_800 if small else 19_000,
        # As many as there are simulations, so that none of them is cut short.
        'evaluation_episodes': 76,
    }


def _page_settings(task: str) -> dict[str, Any]:
    """What the page of the paper's comparison trains: a quarter of an hour of a core or so.

    Long runs compute in bfloat16. Those of the Fetch with an object have a third of the paper's
    steps: with 12 % the one arm that learns is still rising. Hands have the recipe `best`, which
    sees in a million steps what the paper's sees in many.
    """
    if task == 'FetchReach':
        return {'recipe': 'paper', **reduced_budget(task)}
    if task.startswith('Fetch'):
        longer = {'total_steps': 1_500_000, 'evaluate_every': 38_000, 'precision': 'bfloat16'}
        return {'recipe': 'paper', **reduced_budget(task), **longer}
    return HAND


PAPER = Study(
    'paper',
    None,
    'What do hindsight and dense rewards do to DDPG, on every task of the paper?',
    {task: _page_settings(task) for task in TASKS},
    tuple(ARMS.values()),
)
"""The paper's own comparison as a study with a page."""


def paper_jobs(
    tasks: Sequence[str],
    arms: Sequence[str],
    seeds: Sequence[int],
    recipe: str,
    overrides: dict[str, Any],
    output: Path,
) -> list[Job]:
    """Task x arm x seed, seed by seed, so that an early stop leaves all arms with as many seeds.

    Args:
        tasks: Task names.
        arms: Keys of `ARMS`.
        seeds: Seeds.
        recipe: The recipe of all jobs.
        overrides: Fields of `TrainConfig` for all jobs; what the arms differ in is theirs.
        output: Folder for all runs.

    Raises:
        ValueError: If a value is not allowed.
    """
    jobs = []
    for task in tasks:
        for seed in seeds:
            for arm in (ARMS[name] for name in arms):
                values = {**overrides, **arm.changes, 'seed': seed}
                config = recipe_config(task, recipe, **values)
                jobs.append(Job(arm, config, output / task / arm.name / f'seed{seed}'))
    return jobs


def best_jobs(
    tasks: Sequence[str], seeds: Sequence[int], overrides: dict[str, Any], output: Path
) -> list[Job]:
    """The best recipe of each task; some start from the networks of another that comes before.

    A task whose predecessor is not among the tasks starts from nothing.

    Args:
        tasks: Task names.
        seeds: Seeds.
        overrides: Fields of `TrainConfig` for all jobs.
        output: Folder for all runs.

    Raises:
        ValueError: If a value is not allowed.
    """
    jobs: dict[tuple[str, int], Job] = {}
    for seed in seeds:
        for task in (name for name in BEST_ORDER if name in tasks):
            before = jobs.get((STARTS_FROM.get(task, ''), seed))
            start = start_from(task, str(before.folder)) if before else {}
            config = recipe_config(task, 'best', **{**start, **overrides, 'seed': seed})
            folder = output / task / BEST_ARM.name / f'seed{seed}'
            jobs[task, seed] = Job(BEST_ARM, config, folder, before)
    return list(jobs.values())


assert set(BEST_ORDER) == set(TASKS)
