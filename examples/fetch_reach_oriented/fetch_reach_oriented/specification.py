"""What the network and a policy know of the task; without MuJoCo."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from msgs_spec.robots import FETCH, CommandPart
from msgs_spec.tasks import Array, GoalKind, TaskFormulas, TaskSpec, VectorPart

# Radians a command of 1 turns the gripper per tick.
TURN_STEP = 0.2

# The fingers stay shut; the gripper is moved as in the Fetch tasks, and turned.
ROBOT = replace(
    FETCH,
    command=(
        *FETCH.command[:3],
        *(CommandPart(f'turn_{axis}', -1.0, 1.0, 'x 0.2 rad') for axis in 'xyz'),
    ),
)


def observation(readings: dict[str, Array], tick_duration: float) -> Array:
    """Pose of the gripper and its velocity per tick, (..., 13)."""
    twist = readings['end_effector_twist'] * tick_duration
    return np.concatenate([readings['end_effector_pose'], twist], axis=-1)


def achieved_goal(readings: dict[str, Array]) -> Array:
    """Pose of the gripper, (..., 7): m, quaternion wxyz."""
    return readings['end_effector_pose'].copy()


FETCH_REACH_ORIENTED = TaskSpec(
    name='FetchReachOriented',
    robot=ROBOT,
    goal=GoalKind.POSE,
    observation=(
        VectorPart('end_effector_pose', 7, 'm, quaternion wxyz'),
        VectorPart('end_effector_velocity', 3, 'm per tick'),
        VectorPart('end_effector_angular_velocity', 3, 'rad per tick'),
    ),
    episode_ticks=50,
    object_name=None,
    distance_threshold=0.05,
    rotation_threshold=0.2,
    reference_id=None,
    achieved_goal='end_effector_pose',
    formulas=TaskFormulas(
        topics=('end_effector_pose', 'end_effector_twist'),
        observation=observation,
        achieved_goal=achieved_goal,
    ),
)
