"""Formulas of the observation vectors.

Simulation and policies call the same functions, so observations on ROS equal those of training bit
for bit. The functions accept any leading batch shape, work element by element and return new
float64 arrays.
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

# Maximum number of joints that an error names.
_NAMED = 4

# Sensor readings: vectors (..., topic.size) by name of the topic.
Readings = Mapping[str, Array]


def observation(task: TaskSpec, readings: Readings, tick_duration: float) -> Array:
    """Return observation vectors (..., task.observation_size); `task.observation` names the parts.

    `readings` contain at least `task.observed_topics`, with unit quaternions. `tick_duration` is
    one control period, s.
    """
    if task.formulas is not None:
        return task.formulas.observation(readings, tick_duration)
    if task.robot.has_gripper_command:
        return np.concatenate(_fetch_parts(task, readings, tick_duration), axis=-1)
    # Positions and velocities, without the efforts.
    joints = readings['joint_states'][..., : 2 * len(task.robot.joints)]
    if task.goal is GoalKind.FINGERTIPS:
        # `shadow_dexterous_hand/reach.py` of Gymnasium-Robotics.
        return np.concatenate([joints, _fingertip_positions(readings)], axis=-1)
    # `shadow_dexterous_hand/manipulate.py`.
    free_joint = readings['object_joint']
    return np.concatenate([joints, free_joint[..., 7:], free_joint[..., :7]], axis=-1)


def _fetch_parts(task: TaskSpec, readings: Readings, tick_duration: float) -> list[Array]:
    """Return the observation parts of a Fetch task in the order of Gymnasium-Robotics.

    Velocities are m or rad per tick: values per second are multiplied by `tick_duration`, s.
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
    """Return fingertip positions (..., 15), m, in a new array."""
    poses = readings['fingertip_poses']
    positions = poses.reshape(*poses.shape[:-1], len(FINGERTIPS), 7)[..., :3]
    return positions.reshape(*poses.shape[:-1], 3 * len(FINGERTIPS))


def achieved_goal(task: TaskSpec, readings: Readings) -> Array:
    """Return achieved goals (..., task.goal.size), m and quaternion wxyz, in a new array."""
    if task.formulas is not None:
        return task.formulas.achieved_goal(readings)
    if task.goal is GoalKind.FINGERTIPS:
        return _fingertip_positions(readings)
    if task.goal is GoalKind.POSE:
        return readings['object_joint'][..., :7].copy()
    place = readings['object_pose' if task.has_object else 'end_effector_pose']
    return place[..., :3].copy()


class ObservationAssembler:
    """Computes the observation dictionary of a task from the topics of one tick.

    `control_hz` is the number of ticks per simulated second, as in `episode_status`.
    """

    def __init__(self, task: TaskSpec, control_hz: float) -> None:
        self._task = task
        self._tick_duration = substeps_per_tick(control_hz) * PHYSICS_TIMESTEP
        names = (*task.observed_topics, 'achieved_goal', 'desired_goal')
        self.topics = tuple(topic(task, name) for name in names)

    def assemble(self, vectors: Readings) -> dict[str, Array]:
        """Return `observation`, `achieved_goal` and `desired_goal`, float64.

        Args:
            vectors: Vectors (..., topic.size) by topic, with any leading axes, such as ticks.

        Raises:
            ValueError: If a topic is missing, or a value is not finite.
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
                labels = [f'{part.name} of {name}' for part in spec.layout for name in spec.names]
                places = filter(self._reads, np.flatnonzero(strange).tolist())
                if found := [labels[place] for place in places]:
                    return f'{spec.name}: no finite {first_of(found, _NAMED)}'
            elif strange.any():
                return f'{spec.name}: not every value is finite'
        return 'a value is too large for an observation'

    def _reads(self, place: int) -> bool:
        """Return whether the observation depends on `joint_states[place]`."""
        readings = {spec.name: np.ones(spec.size) for spec in self.topics}
        readings['joint_states'][place] = np.nan
        found = observation(self._task, readings, self._tick_duration)
        return not np.isfinite(found).all()
