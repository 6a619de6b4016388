"""The study `best`: the best recipe of every task, some starting from networks of another."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS, task_spec
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.studies.study import Arm, Job, Study

BEST = Study(
    'best',
    None,
    'What does each recipe reach?',
    {},
    (Arm('best', 'DDPG+HER, best recipe'),),
    seeds=1,
)

# Long trainings first. Networks that can turn the block (XYZ) help in every other block task;
# likewise for egg and pen.
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
# Settings that preserve trained networks: a full replay before the first update, smaller steps and
# less noise. Where goals gain a position, they are coarse at first (docs/lab_notes).
_FINE_TUNING = {
    'learning_starts': 100_000,
    'learning_rate': 5e-4,
    'noise_std': 0.15,
    'random_epsilon': 0.2,
}
_COARSE_FIRST = {'first_distance': 8.0}
# Most noise drops a pen. A drop that ends the episode teaches holding only while the policy also
# reaches some goals.
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
    """Return the fields of a run that starts from networks of the task in `STARTS_FROM`."""
    coarse = _COARSE_FIRST if task_spec(task).position_counts else {}
    held = _HELD if 'Pen' in task else {}
    return {**_FINE_TUNING, **coarse, **held, 'init_from': networks}


def best_jobs(
    tasks: Sequence[str], seeds: Sequence[int], overrides: dict[str, Any], output: Path
) -> list[Job]:
    """Return the best recipe of each task, some starting from the networks of an earlier job.

    A task starts from random networks if its predecessor is not among the tasks.

    Raises:
        ValueError: If a value is not allowed.
    """
    jobs: dict[tuple[str, int], Job] = {}
    (arm,) = BEST.arms
    for seed in seeds:
        for task in (name for name in BEST_ORDER if name in tasks):
            before = jobs.get((STARTS_FROM.get(task, ''), seed))
            start = start_from(task, str(before.folder)) if before else {}
            config = recipe_config(task, 'best', **{**start, **overrides, 'seed': seed})
            folder = output / task / arm.name / f'seed{seed}'
            jobs[task, seed] = Job(arm, config, folder, before)
    return list(jobs.values())


assert set(BEST_ORDER) == set(TASKS)
