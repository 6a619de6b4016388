"""The tasks as data: goals, observations, lengths, thresholds.

Thirteen come from Plappert et al. 2018; other packages may add tasks (`foreign_tasks.py`).
"""

from __future__ import annotations

from dataclasses import replace
from numbers import Real
from typing import Literal, get_args

# Third-party tasks import it from here.
from msgs_spec.arrays import Array as Array
from msgs_spec.foreign_tasks import foreign_tasks
from msgs_spec.robots import FETCH, FINGERTIPS, JOINT_PREFIX, SHADOW_HAND
from msgs_spec.task_types import GoalKind, TaskFormulas, TaskSpec, VectorPart
from msgs_spec.text import did_you_mean

__all__ = [
    'DEFAULT_CONTROL_HZ',
    'PHYSICS_TIMESTEP',
    'REWARD_TYPES',
    'SUCCESS_RULES',
    'TASKS',
    'TIMINGS',
    'GoalKind',
    'RewardType',
    'SuccessRule',
    'TaskFormulas',
    'TaskSpec',
    'Timing',
    'VectorPart',
    'substeps_per_tick',
    'task_spec',
]

# One physics substep, seconds, and the paper's 20 substeps per action (25 Hz).
PHYSICS_TIMESTEP = 0.002
DEFAULT_CONTROL_HZ = 25.0

# `GoalMetric` of the simulation explains them.
RewardType = Literal['sparse', 'dense']
SuccessRule = Literal['gymnasium', 'paper']
# What stays the same at rates other than 25 Hz: the seconds of an episode and the speed of a
# gripper, or the ticks of an episode and the step of a gripper (as up to version 1.0).
Timing = Literal['seconds', 'ticks']
REWARD_TYPES: tuple[RewardType, ...] = get_args(RewardType)
SUCCESS_RULES: tuple[SuccessRule, ...] = get_args(SuccessRule)
TIMINGS: tuple[Timing, ...] = get_args(Timing)


_GRIPPER_STATE = VectorPart('gripper_state', 2, 'm, right and left finger')
_GRIPPER_VELOCITY = VectorPart('gripper_velocity', 2, 'm per tick')
_FETCH_REACH_OBSERVATION = (
    VectorPart('end_effector_position', 3, 'm'),
    _GRIPPER_STATE,
    VectorPart('end_effector_velocity', 3, 'm per tick'),
    _GRIPPER_VELOCITY,
)
_FETCH_OBJECT_OBSERVATION = (
    VectorPart('end_effector_position', 3, 'm'),
    VectorPart('object_position', 3, 'm'),
    VectorPart('object_relative_position', 3, 'm'),
    _GRIPPER_STATE,
    VectorPart('object_rotation', 3, 'rad, Euler xyz'),
    VectorPart('object_relative_velocity', 3, 'm per tick'),
    VectorPart('object_angular_velocity', 3, 'rad per tick'),
    VectorPart('end_effector_velocity', 3, 'm per tick'),
    _GRIPPER_VELOCITY,
)
_HAND_JOINT_PARTS = (
    VectorPart('joint_position', len(SHADOW_HAND.joints), 'rad'),
    VectorPart('joint_velocity', len(SHADOW_HAND.joints), 'rad/s'),
)
_HAND_REACH_OBSERVATION = (
    *_HAND_JOINT_PARTS,
    VectorPart('fingertip_positions', 3 * len(FINGERTIPS), 'm'),
)
_HAND_OBJECT_OBSERVATION = (
    *_HAND_JOINT_PARTS,
    VectorPart('object_velocity', 6, 'm/s in the world, rad/s in the object frame'),
    VectorPart('object_pose', 7, 'm, quaternion wxyz'),
)


def _fetch(name: str, has_object: bool = True) -> TaskSpec:
    return TaskSpec(
        name=name,
        robot=FETCH,
        goal=GoalKind.POINT,
        observation=_FETCH_OBJECT_OBSERVATION if has_object else _FETCH_REACH_OBSERVATION,
        episode_ticks=50,
        object_name='object0' if has_object else None,
        distance_threshold=0.05,
        rotation_threshold=None,
        reference_id=f'{name}-v4',
        achieved_goal='object_position' if has_object else 'end_effector_position',
        looks_like=name,
    )


def _hand_manipulate(
    name: str,
    distance_threshold: float = 0.01,
    position_counts: bool = False,
    ignores_z_rotation: bool = False,
) -> TaskSpec:
    return TaskSpec(
        name=name,
        robot=SHADOW_HAND,
        goal=GoalKind.POSE,
        observation=_HAND_OBJECT_OBSERVATION,
        episode_ticks=100,
        object_name='object',
        distance_threshold=distance_threshold,
        rotation_threshold=0.1,
        reference_id=f'{name}-v1',
        achieved_goal='object_pose',
        looks_like=name,
        position_counts=position_counts,
        ignores_z_rotation=ignores_z_rotation,
        object_symmetry='cube' if 'Block' in name else 'revolution',
    )


_HAND_REACH = TaskSpec(
    name='HandReach',
    robot=SHADOW_HAND,
    goal=GoalKind.FINGERTIPS,
    observation=_HAND_REACH_OBSERVATION,
    episode_ticks=50,
    object_name=None,
    distance_threshold=0.01,
    rotation_threshold=None,
    reference_id='HandReach-v3',
    achieved_goal='fingertip_positions',
    looks_like='HandReach',
)

TASKS: dict[str, TaskSpec] = {
    spec.name: spec
    for spec in (
        _fetch('FetchReach', has_object=False),
        _fetch('FetchPush'),
        _fetch('FetchSlide'),
        _fetch('FetchPickAndPlace'),
        _HAND_REACH,
        _hand_manipulate('HandManipulateBlockRotateZ'),
        _hand_manipulate('HandManipulateBlockRotateParallel'),
        _hand_manipulate('HandManipulateBlockRotateXYZ'),
        _hand_manipulate('HandManipulateBlockFull', position_counts=True),
        _hand_manipulate('HandManipulateEggRotate'),
        _hand_manipulate('HandManipulateEggFull', position_counts=True),
        _hand_manipulate('HandManipulatePenRotate', 0.05, ignores_z_rotation=True),
        _hand_manipulate('HandManipulatePenFull', 0.05, True, ignores_z_rotation=True),
    )
}


def task_spec(
    name: str, joint_prefix: str = JOINT_PREFIX, control_hz: float = DEFAULT_CONTROL_HZ
) -> TaskSpec:
    """Returns the task called `name`.

    Args:
        name: One of `TASKS`.
        joint_prefix: What the names of its joints begin with on the network.
        control_hz: Action frequency, Hz. At another than 25 Hz an episode has as many steps as fill
            the same time, rounded.

    Raises:
        ValueError: If there is none, the message lists all of them; or the rate is not allowed.
    """
    try:
        task = TASKS[name]
    except (KeyError, TypeError):
        hint = did_you_mean(str(name), TASKS.keys())
        raise ValueError(f'unknown task {name!r}; allowed: {", ".join(TASKS)}{hint}') from None
    if control_hz != DEFAULT_CONTROL_HZ:
        substeps = task.episode_ticks * substeps_per_tick(DEFAULT_CONTROL_HZ)
        ticks = round(substeps / substeps_per_tick(control_hz))
        task = replace(task, episode_ticks=max(1, ticks))
    return task.with_joint_prefix(joint_prefix)


def substeps_per_tick(control_hz: float) -> int:
    """Returns the whole number of physics substeps in one control period.

    Args:
        control_hz: Action frequency in Hz, between 12.5 and 500.

    Raises:
        ValueError: If the period is not a whole number of substeps; the message names the nearest
            valid rates.
    """
    if not isinstance(control_hz, Real):
        raise ValueError(f'control_hz {control_hz!r} is no number; allowed: 12.5 ... 500')
    smallest, largest = 1, 40
    period = 1.0 / (control_hz * PHYSICS_TIMESTEP) if control_hz > 0 else float('inf')
    substeps = round(period) if period < 1e9 else 10**9
    if smallest <= substeps <= largest and abs(period - substeps) < 1e-6:
        return substeps
    lower = min(max(int(period) if period < 1e9 else largest, smallest), largest)
    # No rate above 500 Hz is valid.
    upper = min(lower + 1, largest) if period > smallest else lower
    rates = sorted({1.0 / (n * PHYSICS_TIMESTEP) for n in (lower, upper)})
    nearest = ' and '.join(f'{rate:.9g}' for rate in rates)
    raise ValueError(
        f'control_hz {control_hz:g} is not a whole number of {PHYSICS_TIMESTEP * 1e3:g} ms '
        f'substeps; allowed: 500/n Hz for n = {smallest} ... {largest} (12.5 ... 500), nearest: '
        f'{nearest}'
    )


# Third-party packages import this module, so this line comes last.
TASKS.update(foreign_tasks(known=TASKS))
