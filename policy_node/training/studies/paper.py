"""The studies `paper` (four variants) and `best` (the best recipe of every task)."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.tasks import TASKS, task_spec
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.studies.research import HAND
from policy_node.training.studies.study import Arm, Job, Study

_NO_HINDSIGHT = {'strategy': 'none', 'goals': ''}
ARMS = {
    arm.name: arm
    for arm in (
        Arm('her_sparse', 'DDPG+HER, sparse', {'reward_type': 'sparse'}),
        Arm('her_dense', 'DDPG+HER, dense', {'reward_type': 'dense'}),
        Arm('ddpg_sparse', 'DDPG, sparse', {'reward_type': 'sparse', **_NO_HINDSIGHT}),
        Arm('ddpg_dense', 'DDPG, dense', {'reward_type': 'dense', **_NO_HINDSIGHT}),
    )
}
"""The four curves in each panel of the paper's figures."""
BEST_ARM = Arm('best', 'DDPG+HER, best recipe')

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


def reduced_budget(task: str) -> dict[str, Any]:
    """Return the fields that make the `paper` recipe fit one machine.

    Steps are 1.2 % (FetchReach) or 12 % of the paper's, batches 256 or 1024 instead of 4864. One
    collection of 76 episodes replaces two of 38, with twice the updates. Targets move every 10
    updates instead of 40, because there are so few.
    """
    small = task == 'FetchReach'
    full = recipe_config(task, 'paper').run.total_steps
    return {
        'total_steps': full * 12 // (1000 if small else 100),
        'num_envs': 76,
        'updates_per_cycle': 80,
        'batch_size': 256 if small else 1024,
        'target_update_interval': 10,
        'replay_transitions': 1_000_000,
        'evaluate_every': 3_800 if small else 19_000,
        # As many as simulations, so that no evaluation ends early.
        'evaluation_episodes': 76,
    }


def _page_settings(task: str) -> dict[str, Any]:
    """Return the settings of the page: about a quarter of an hour of one core per run.

    Long runs compute in bfloat16. Fetch tasks with an object have a third of the paper's steps:
    after 12 % the learning variant is still rising. Hand tasks use the recipe `best`, which learns
    in a million steps what the paper's recipe learns in many.
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
"""The paper's comparison as a study with a page."""


def best_jobs(
    tasks: Sequence[str], seeds: Sequence[int], overrides: dict[str, Any], output: Path
) -> list[Job]:
    """Return the best recipe of each task, some starting from the networks of an earlier job.

    A task starts from random networks if its predecessor is not among the tasks.

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
