"""Ticks of every task filled with random numbers."""

from __future__ import annotations

import numpy as np

from msgs_spec.tasks import GoalKind, TaskSpec
from msgs_spec.tick import EpisodeStatus, Tick

STAMP = 12 * 10**9 + 40_000_000


def episode_status(task: TaskSpec) -> EpisodeStatus:
    """A status with numbers whose text form is not short."""
    return EpisodeStatus(
        task=task.name,
        episode=3,
        seed=2**32 - 1,
        tick=1,
        phase='running',
        control_hz=500 / 3,
        reward_type='dense',
        success_rule='paper',
        episode_return=-0.1 - 0.2,
        is_success=True,
    )


def random_tick(task: TaskSpec, seed: int = 0) -> Tick:
    """A tick with random numbers for all that the task has."""
    joints = len(task.robot.joints)
    sizes = dict.fromkeys(('joint_position', 'joint_velocity', 'joint_effort'), joints)
    if task.robot.has_gripper_command:
        sizes |= {'end_effector_position': 3, 'end_effector_quaternion': 4}
        sizes |= {'end_effector_linear_velocity': 3, 'end_effector_angular_velocity': 3}
    else:
        sizes['fingertip_positions'] = 15
    if task.has_object:
        sizes |= {'object_position': 3, 'object_quaternion': 4}
        sizes |= {'object_linear_velocity': 3, 'object_angular_velocity': 3}
    if task.goal is GoalKind.POSE:
        sizes |= {'object_qpos': 7, 'object_qvel': 6}
    sizes |= dict.fromkeys(('desired_goal', 'achieved_goal'), task.goal.size)
    sizes['applied_command'] = task.robot.action_size
    generator = np.random.default_rng(seed)
    return Tick(
        stamp_ns=STAMP,
        reward=float(generator.normal()),
        is_success=True,
        status=episode_status(task),
        **{name: generator.normal(size=size) for name, size in sizes.items()},
    )
