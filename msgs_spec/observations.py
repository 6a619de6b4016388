"""The observation vectors of the benchmark: the one place of their formulas.

The simulation and the policy call the same functions, so an actor sees on ROS what it was trained
on, bit for bit. The functions take any leading batch shape, work element by element and return
fresh float64 arrays.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from msgs_spec.arrays import Array
from msgs_spec.robots import FINGERTIPS
from msgs_spec.rotations import matrix_to_euler, quaternion_to_matrix
from msgs_spec.tasks import PHYSICS_TIMESTEP, GoalKind, TaskSpec, substeps_per_tick
from msgs_spec.text import first_of
from msgs_spec.topics import topic

# Joints without a value that are named in an error.
_NAMED = 4

# What sensors say: vectors (..., topic.size) by name of the topic.
Readings = Mapping[str, Array]


def observed_topics(task: TaskSpec) -> tuple[str, ...]:
    """Names of the topics from which the observation of a task is made."""
    if task.formulas is not None:
        return task.formulas.topics
    if task.goal is GoalKind.FINGERTIPS:
        return ('joint_states', 'fingertip_poses')
    if task.goal is GoalKind.POSE:
        return ('joint_states', 'object_joint')
    robot = ('joint_states', 'end_effector_pose', 'end_effector_twist')
    return (*robot, 'object_pose', 'object_twist') if task.has_object else robot


def observation(task: TaskSpec, readings: Readings, tick_duration: float) -> Array:
    """Observation vectors from what the sensors say; `task.observation` names their parts.

    Args:
        task: The task.
        readings: At least its `observed_topics`; quaternions of unit length.
        tick_duration: Seconds of one control period.

    Returns:
        (..., task.observation_size).
    """
    if task.formulas is not None:
        return task.formulas.observation(readings, tick_duration)
    if task.robot.has_gripper_command:
        return np.concatenate(_fetch_parts(task, readings, tick_duration), axis=-1)
    # Positions and velocities; efforts follow them.
    joints = readings['joint_states'][..., : 2 * len(task.robot.joints)]
    if task.goal is GoalKind.FINGERTIPS:
        # `shadow_dexterous_hand/reach.py` of Gymnasium-Robotics.
        return np.concatenate([joints, _fingertip_positions(readings)], axis=-1)
    # `shadow_dexterous_hand/manipulate.py`.
    free_joint = readings['object_joint']
    return np.concatenate([joints, free_joint[..., 7:], free_joint[..., :7]], axis=-1)


def _fetch_parts(task: TaskSpec, readings: Readings, tick_duration: float) -> list[Array]:
    """What `generate_mujoco_observations` of `fetch_env.py` puts together.

    Velocities are per tick there, hence `tick_duration`.
    """
    count, joints = len(task.robot.joints), readings['joint_states']
    fingers = joints[..., count - 2 : count]
    fingers_velocity = joints[..., 2 * count - 2 : 2 * count] * tick_duration
    gripper = readings['end_effector_pose'][..., :3]
    gripper_velocity = readings['end_effector_twist'][..., :3] * tick_duration
    if not task.has_object:
        return [gripper, fingers, gripper_velocity, fingers_velocity]
    place, quaternion = readings['object_pose'][..., :3], readings['object_pose'][..., 3:]
    twist = readings['object_twist'] * tick_duration
    return [
        gripper,
        place,
        place - gripper,
        fingers,
        matrix_to_euler(quaternion_to_matrix(quaternion)),
        twist[..., :3] - gripper_velocity,
        twist[..., 3:],
        gripper_velocity,
        fingers_velocity,
    ]


def _fingertip_positions(readings: Readings) -> Array:
    """Fingertip positions (..., 15), m, a fresh array."""
    poses = readings['fingertip_poses']
    positions = poses.reshape(*poses.shape[:-1], len(FINGERTIPS), 7)[..., :3]
    return positions.reshape(*poses.shape[:-1], 3 * len(FINGERTIPS))


def achieved_goal(task: TaskSpec, readings: Readings) -> Array:
    """Achieved goals (..., task.goal.size) from what the sensors say, a fresh array."""
    if task.formulas is not None:
        return task.formulas.achieved_goal(readings)
    if task.goal is GoalKind.FINGERTIPS:
        return _fingertip_positions(readings)
    if task.goal is GoalKind.POSE:
        return readings['object_joint'][..., :7].copy()
    place = readings['object_pose' if task.has_object else 'end_effector_pose']
    return place[..., :3].copy()


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
        names = (*observed_topics(task), 'achieved_goal', 'desired_goal')
        self.topics = tuple(topic(task, name) for name in names)

    def assemble(self, vectors: Readings) -> dict[str, Array]:
        """Returns `observation`, `achieved_goal` and `desired_goal`, float64.

        Args:
            vectors: What `codecs.decode` made of each topic, by name, (..., topic.size) with any
                leading axes, such as ticks; others are ignored.

        Raises:
            ValueError: If a topic is missing, or a value that is needed is not finite. Others need
                not be there, such as the efforts of a robot that measures none.
        """
        for name in (spec.name for spec in self.topics):
            if name not in vectors:
                raise ValueError(f'no {name} for an observation of {self._task.name}')
        with np.errstate(all='ignore'):
            found = observation(self._task, vectors, self._tick_duration)
        goals = {name: vectors[name].copy() for name in ('achieved_goal', 'desired_goal')}
        if not all(np.isfinite(values).all() for values in (found, *goals.values())):
            raise ValueError(self._what_is_not_finite(vectors))
        return {'observation': found, **goals}

    def _what_is_not_finite(self, vectors: Readings) -> str:
        for spec in self.topics:
            strange = ~np.isfinite(vectors[spec.name].reshape(-1, spec.size)).all(axis=0)
            if spec.name == 'joint_states':
                # Parts one after the other, each with a value for every joint.
                labels = [f'{part.name} of {name}' for part in spec.layout for name in spec.names]
                found = [labels[place] for place in np.flatnonzero(strange).tolist()]
                # No observation is made of efforts.
                found = [label for label in found if not label.startswith('effort')]
                if found:
                    return f'{spec.name}: no finite {first_of(found, _NAMED)}'
            elif strange.any():
                return f'{spec.name}: not every value is finite'
        return 'too large a value for an observation'
