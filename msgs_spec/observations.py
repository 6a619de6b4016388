"""The observation vectors of the benchmark: the one place of their formulas.

The simulation and the policy call the same functions, so an actor sees on ROS what it was trained
on, bit for bit. The functions take any leading batch shape, work element by element and return
fresh float64 arrays.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.rotations import matrix_to_euler, quaternion_to_matrix
from msgs_spec.tasks import PHYSICS_TIMESTEP, GoalKind, TaskSpec, substeps_per_tick
from msgs_spec.topics import topic

Array = NDArray[np.float64]


def fetch_observation(
    end_effector_position: ArrayLike,
    end_effector_velocity: ArrayLike,
    joint_position: ArrayLike,
    joint_velocity: ArrayLike,
    tick_duration: float,
    object_position: ArrayLike | None = None,
    object_quaternion: ArrayLike | None = None,
    object_linear_velocity: ArrayLike | None = None,
    object_angular_velocity: ArrayLike | None = None,
) -> Array:
    """Observation of the Fetch tasks (`generate_mujoco_observations` of `fetch_env.py`).

    Velocities are per tick there, hence `tick_duration`. Without an object it is FetchReach's.

    Args:
        end_effector_position: (..., 3), site `robot0:grip`, m, world.
        end_effector_velocity: (..., 3), m/s, world.
        joint_position: (..., 15), order of `joint_states`; the last two are the fingers, m.
        joint_velocity: (..., 15), likewise, m/s.
        tick_duration: Seconds of one control period.
        object_position: (..., 3), m, world.
        object_quaternion: (..., 4), wxyz, unit length.
        object_linear_velocity: (..., 3), m/s, world.
        object_angular_velocity: (..., 3), rad/s, world.

    Returns:
        (..., 10) without an object, (..., 25) with one.

    Raises:
        ValueError: If there is an object position but not the other object values.
    """
    gripper = np.asarray(end_effector_position, dtype=np.float64)
    gripper_velocity = np.asarray(end_effector_velocity, dtype=np.float64) * tick_duration
    fingers = np.asarray(joint_position, dtype=np.float64)[..., -2:]
    fingers_velocity = np.asarray(joint_velocity, dtype=np.float64)[..., -2:] * tick_duration
    if object_position is None:
        return np.concatenate([gripper, fingers, gripper_velocity, fingers_velocity], axis=-1)
    if (
        object_quaternion is None
        or object_linear_velocity is None
        or object_angular_velocity is None
    ):
        raise ValueError(
            'object_position given without object_quaternion, object_linear_velocity and '
            'object_angular_velocity; allowed: all four or none'
        )
    position = np.asarray(object_position, dtype=np.float64)
    velocity = np.asarray(object_linear_velocity, dtype=np.float64) * tick_duration
    rotation_velocity = np.asarray(object_angular_velocity, dtype=np.float64) * tick_duration
    return np.concatenate(
        [
            gripper,
            position,
            position - gripper,
            fingers,
            matrix_to_euler(quaternion_to_matrix(object_quaternion)),
            velocity - gripper_velocity,
            rotation_velocity,
            gripper_velocity,
            fingers_velocity,
        ],
        axis=-1,
    )


def hand_reach_observation(
    joint_position: ArrayLike, joint_velocity: ArrayLike, fingertip_positions: ArrayLike
) -> Array:
    """Observation of HandReach (`shadow_dexterous_hand/reach.py` of Gymnasium-Robotics).

    Args:
        joint_position: (..., 24), rad.
        joint_velocity: (..., 24), rad/s.
        fingertip_positions: (..., 15), m, world, fingers in the order of `robots.FINGERTIPS`.

    Returns:
        (..., 63).
    """
    return _concatenate(joint_position, joint_velocity, fingertip_positions)


def hand_object_observation(
    joint_position: ArrayLike,
    joint_velocity: ArrayLike,
    object_qvel: ArrayLike,
    object_qpos: ArrayLike,
) -> Array:
    """Observation of the hand manipulation tasks (`shadow_dexterous_hand/manipulate.py`).

    Args:
        joint_position: (..., 24), rad.
        joint_velocity: (..., 24), rad/s.
        object_qvel: (..., 6), the free joint's velocity as MuJoCo holds it: m/s (world) and rad/s
            (object frame).
        object_qpos: (..., 7), the free joint's position: m (world), quaternion wxyz.

    Returns:
        (..., 61).
    """
    return _concatenate(joint_position, joint_velocity, object_qvel, object_qpos)


def _concatenate(*parts: ArrayLike) -> Array:
    return np.concatenate([np.asarray(part, dtype=np.float64) for part in parts], axis=-1)


class ObservationAssembler:
    """Rebuilds the dict observation of a task from its topics of one stamp.

    Args:
        task: The task.
        control_hz: Ticks per simulated second, as `episode_status` says.

    Attributes:
        topics: The topics that are needed.

    Raises:
        ValueError: If the rate is not allowed.
    """

    def __init__(self, task: TaskSpec, control_hz: float) -> None:
        self._task = task
        self._tick_duration = substeps_per_tick(control_hz) * PHYSICS_TIMESTEP
        names = (*_observed_topics(task), 'achieved_goal', 'desired_goal')
        self.topics = tuple(topic(task, name) for name in names)

    def assemble(self, vectors: Mapping[str, Array]) -> dict[str, Array]:
        """Returns `observation`, `achieved_goal` and `desired_goal`, float64.

        Args:
            vectors: What `codecs.decode` made of each topic, by name, (..., topic.size) with any
                leading axes, such as ticks; others are ignored.

        Raises:
            ValueError: If a topic is missing or holds a value that is not finite.
        """
        for name in (spec.name for spec in self.topics):
            if name not in vectors:
                raise ValueError(f'no {name} for an observation of {self._task.name}')
            if not np.isfinite(vectors[name]).all():
                raise ValueError(f'{name}: not every value is finite')
        return {
            'observation': self._observation(vectors),
            'achieved_goal': vectors['achieved_goal'].copy(),
            'desired_goal': vectors['desired_goal'].copy(),
        }

    def _observation(self, vectors: Mapping[str, Array]) -> Array:
        position, velocity, _ = np.split(vectors['joint_states'], 3, axis=-1)
        if self._task.robot.has_gripper_command:
            return self._fetch(position, velocity, vectors)
        if self._task.goal is GoalKind.FINGERTIPS:
            return hand_reach_observation(position, velocity, vectors['fingertip_poses'])
        qpos, qvel = np.split(vectors['object_joint'], [7], axis=-1)
        return hand_object_observation(position, velocity, qvel, qpos)

    def _fetch(self, position: Array, velocity: Array, vectors: Mapping[str, Array]) -> Array:
        gripper = vectors['end_effector_pose'][..., :3]
        gripper_velocity = vectors['end_effector_twist'][..., :3]
        robot = (gripper, gripper_velocity, position, velocity, self._tick_duration)
        if not self._task.has_object:
            return fetch_observation(*robot)
        object_position, object_quaternion = np.split(vectors['object_pose'], [3], axis=-1)
        linear, angular = np.split(vectors['object_twist'], 2, axis=-1)
        return fetch_observation(*robot, object_position, object_quaternion, linear, angular)


def _observed_topics(task: TaskSpec) -> tuple[str, ...]:
    if task.goal is GoalKind.FINGERTIPS:
        return ('joint_states', 'fingertip_poses')
    if task.goal is GoalKind.POSE:
        return ('joint_states', 'object_joint')
    robot = ('joint_states', 'end_effector_pose', 'end_effector_twist')
    return (*robot, 'object_pose', 'object_twist') if task.has_object else robot
