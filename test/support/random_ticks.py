"""Ticks of every task filled with random numbers."""

from __future__ import annotations

import numpy as np

from msgs_spec.tasks import GoalKind, TaskSpec
from msgs_spec.tick import EpisodeStatus, Tick
from msgs_spec.topics import topic

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
    sizes = {name: topic(task, name).size for name in sensed_topics(task)}
    sizes |= dict.fromkeys(('desired_goal', 'achieved_goal'), task.goal.size)
    sizes['applied_command'] = task.robot.action_size
    generator = np.random.default_rng(seed)
    vectors = {name: generator.normal(size=size) for name, size in sizes.items()}
    return Tick(
        stamp_ns=STAMP,
        readings={name: vectors.pop(name) for name in sensed_topics(task)},
        reward=float(generator.normal()),
        is_success=True,
        status=episode_status(task),
        **vectors,
    )


def sensed_topics(task: TaskSpec) -> list[str]:
    """Return the names of the topics with sensor readings, in order."""
    if task.robot.has_gripper_command:
        robot = ['joint_states', 'end_effector_pose', 'end_effector_twist']
    else:
        robot = ['joint_states', 'fingertip_poses']
    objects = ['object_pose', 'object_twist'] if task.has_object else []
    return [*robot, *objects, *(['object_joint'] if task.goal is GoalKind.POSE else [])]
