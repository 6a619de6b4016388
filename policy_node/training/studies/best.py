"""The study `best`: train each task with its best recipe, some from networks of another task."""

from __future__ import annotations

from msgs_spec.tasks import task_spec
from policy_node.training.configuration.recipes import FINE_TUNED
from policy_node.training.studies.study import Arm, Start, Study

# Long trainings first. Networks that can turn the block (XYZ) help in harder block tasks; likewise
# for egg and pen.
_ORDER = (
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
_STARTS_FROM = {
    'HandManipulateBlockRotateParallel': 'HandManipulateBlockRotateXYZ',
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


# A job collects and learns at the same time, in a thread each.
_OVERLAPPING = {'overlap': True, 'precision': 'auto'}


def _start(task: str) -> Start:
    """Return the run whose networks `task` starts from, and the fields to fine-tune them."""
    coarse = _COARSE_FIRST if task_spec(task).position_counts else {}
    held = _HELD if 'Pen' in task else {}
    before = _STARTS_FROM[task]
    arm = 'finetuned' if before in FINE_TUNED else 'best'
    return Start(before, {**_FINE_TUNING, **coarse, **held}, arm)


BEST = Study(
    'best',
    None,
    'What does each recipe reach?',
    {task: _OVERLAPPING for task in _ORDER},
    (
        Arm('best', 'DDPG+HER, best recipe'),
        Arm(
            'finetuned',
            'then recipe finetune',
            {'recipe': 'finetune'},
            after='best',
            tasks=tuple(FINE_TUNED),
        ),
    ),
    seeds=1,
    starts={task: _start(task) for task in _STARTS_FROM},
    ships=True,
)
