"""Checks of arguments: errors name the argument before a library fails on it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation.tasks import Task
from fetch_hand_sim.simulation.tasks.task import free_joint
from msgs_spec.arrays import Array
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.tasks import TaskSpec
from msgs_spec.text import did_you_mean, one_line

Seed = int | np.random.Generator | None
Seeds = int | Sequence[Seed] | None


def require_whole(
    name: str, value: object, lowest: int | None = None, highest: int = 2**31 - 1
) -> None:
    """Raise ValueError unless `value` is an integer (not a boolean) within the limits."""
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f'{name} must be a whole number, not {value!r:.60}')
    if lowest is not None and not lowest <= value <= highest:
        raise ValueError(f'{name} must be {lowest} ... {highest}, not {value!s:.60}')


def numbers(values: ArrayLike, what: str, shape: str) -> NDArray[Any]:
    """Return an array of any shape; raise ValueError for rows of different lengths or objects."""
    try:
        array = np.asarray(values)
    except ValueError:
        array = np.array(None)
    if array.dtype == object:
        raise ValueError(f'{what}: {shape} numbers, not {values!r:.60}')
    return array


def finite_numbers(
    name: str, values: ArrayLike, shape: tuple[int, ...], owner: str
) -> NDArray[np.floating]:
    """Return finite numbers of a shape (N, size) as float32 or float64, or raise ValueError.

    `name` and `owner` describe the numbers in errors.
    """
    array = numbers(values, f'{name} of {owner}', f'{shape}')
    if array.shape != shape:
        raise ValueError(f'{name} of {owner} have shape {shape}, not {array.shape}')
    if array.dtype.kind not in 'iuf':
        raise ValueError(f'{name} must be numbers, not of type {array.dtype}')
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    if not np.isfinite(array).all():
        env, part = np.argwhere(~np.isfinite(array))[0]
        raise ValueError(f'{name} must be finite; {name}[{env}, {part}] is {array[env, part]}')
    return array


def finite_goal(goal: ArrayLike, spec: TaskSpec) -> Array:
    """Return a goal (goal size,) of a task; raise ValueError for a wrong shape or no number."""
    array = np.asarray(goal, dtype=np.float64)
    if array.shape != (spec.goal.size,) or not np.isfinite(array).all():
        raise ValueError(f'a goal of {spec.name} is {spec.goal.size} finite numbers, not {goal!r}')
    return array


def finite_goals(goals: ArrayLike, count: int, spec: TaskSpec) -> Array:
    """Return a new array of goals (count, goal size); raise ValueError as `finite_numbers`."""
    array = finite_numbers('goals', goals, (count, spec.goal.size), owner=spec.name)
    return np.array(array, dtype=np.float64)


def nearest_quaternions(goals: Array, achieved_goals: Array) -> Array:
    """Return poses (n, 7) with unit quaternions in the hemisphere of the object's quaternion.

    A zero quaternion raises ValueError.
    """
    norm = np.linalg.norm(goals[:, 3:], axis=1, keepdims=True)
    if not (norm > 1e-6).all():
        raise ValueError('a goal quaternion must not be zero')
    quaternions = goals[:, 3:] / norm
    quaternions[(quaternions * achieved_goals[:, 3:]).sum(axis=1) < 0.0] *= -1.0
    return np.concatenate([goals[:, :3], quaternions], axis=1)


def selected_simulations(ids: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Return the simulations of distinct indices or of a mask (N,), or raise ValueError."""
    selected = np.asarray(ids)
    if selected.dtype == bool and selected.shape == (num_envs,):
        return np.flatnonzero(selected)
    if selected.ndim == 1 and selected.size == 0:
        return np.zeros(0, dtype=np.intp)
    if selected.ndim != 1 or not np.issubdtype(selected.dtype, np.integer):
        raise ValueError(
            f'ids must be indices below {num_envs} or a boolean mask of shape ({num_envs},), '
            f'not {ids!r}'
        )
    unique = np.unique(selected)
    if unique[0] < 0 or unique[-1] >= num_envs or unique.size != selected.size:
        raise ValueError(f'ids must be distinct and in [0, {num_envs}), not {ids!r}')
    return selected.astype(np.intp)


def generators(seed: Seeds, selected: NDArray[np.intp]) -> list[np.random.Generator | None]:
    """Return a new random generator for each selected simulation; None keeps the old one.

    `seed` is that of `Simulation.reset`. A negative seed or a wrong number of seeds raises
    ValueError, another type TypeError.
    """
    if seed is None:
        return [None] * selected.size
    if isinstance(seed, int | np.integer) and not isinstance(seed, bool):
        return [_generator(int(seed) + int(i)) for i in selected]
    if not isinstance(seed, Sequence | np.ndarray) or isinstance(seed, str | bytes):
        raise TypeError(f'seed {seed!r:.60}; allowed: an integer, a sequence of integers or None')
    if len(seed) != selected.size:
        raise ValueError(f'{len(seed)} seeds for {selected.size} simulations')
    return [None if value is None else _generator(value) for value in seed]


def _generator(seed: Any) -> np.random.Generator:
    if isinstance(seed, np.random.Generator):
        return seed
    if not isinstance(seed, int | np.integer) or isinstance(seed, bool):
        raise TypeError(f'seed {seed!r:.60}; allowed: an integer')
    if seed < 0:
        raise ValueError(f'seed {seed}; allowed: 0 or more')
    return seeding.np_random(int(seed))[0]


# Start states that the user gives in place of drawn ones

PARTS = ('joints', 'joint_velocities', 'object_pose', 'object_velocity')
# m, m/s and rad/s. Joints have the limits of the model.
_FARTHEST, _FASTEST = 10.0, 100.0
# rad and m by which joints exceed their soft limits in simulation.
_SOFT = 0.02
# m. Bodies that are deeper in each other fly apart.
_DEEPEST = 0.005


@dataclass(frozen=True, slots=True)
class StartState:
    """Values of single coordinates, by their place in `qpos` and `qvel`."""

    positions: dict[int, float] = field(default_factory=dict)
    velocities: dict[int, float] = field(default_factory=dict)

    def write(self, qpos: Array, qvel: Array) -> None:
        """Write the values into the rows `qpos` and `qvel` of one simulation."""
        for row, values in ((qpos, self.positions), (qvel, self.velocities)):
            row[list(values)] = list(values.values())


def read_start(given: Any, task: Task) -> StartState:
    """Return the start state that a user describes.

    Velocities of what is placed are zero unless given.

    Args:
        given: A mapping with some of `joints` and `joint_velocities`: numbers by joint name, or all
            in the order of `joint_states`, rad or m (/s); `object_pose`: (7,), m and quaternion
            wxyz, world; `object_velocity`: (6,), linear m/s and angular rad/s, world axes.
    """
    if not isinstance(given, Mapping):
        raise ValueError(f'start {one_line(given, 60)!r}; allowed: a mapping of {_listed(PARTS)}')
    for name in given:
        if name not in PARTS:
            raise ValueError(
                f'start has no {one_line(name, 40)!r}; allowed: {_listed(PARTS)}'
                f'{did_you_mean(str(name), PARTS)}'
            )
    start = StartState()
    readers: dict[str, Callable[[Any, Task, StartState], None]] = {
        'joints': _read_joints,
        'joint_velocities': _read_joint_velocities,
        'object_pose': _read_object_pose,
        'object_velocity': _read_object_velocity,
    }
    # In this order, because placed objects and joints stand still until a velocity is read.
    for name, read in readers.items():
        if name in given:
            read(given[name], task, start)
    if start.positions:
        _require_apart(start, task)
    return start


def _listed(names: Sequence[str]) -> str:
    return ', '.join(names)


def _by_joint(name: str, given: Any, task: Task) -> dict[str, float]:
    """Return a number for each joint that is given."""
    joints = task.spec.robot.joints
    if not isinstance(given, Mapping):
        return dict(zip(joints, _numbers(name, given, len(joints)).tolist(), strict=True))
    for joint in given:
        if joint not in joints:
            raise ValueError(
                f'start {name}: {task.spec.name} has no joint {one_line(joint, 40)!r}; allowed: '
                f'{_listed(joints)}{did_you_mean(str(joint), joints)}'
            )
    return {joint: float(_numbers(f'{name} of {joint}', [v], 1)[0]) for joint, v in given.items()}


def _read_joints(given: Any, task: Task, start: StartState) -> None:
    settled = task.new_data(task.start_state).qpos
    for name, value in _by_joint('joints', given, task).items():
        joint = task.model.joint(name)
        place = int(joint.qposadr[0])
        lowest, highest = joint.range if joint.limited else (-_FARTHEST, _FARTHEST)
        # The settled torso of Fetch is below its range.
        lowest = min(lowest, float(settled[place]))
        if not lowest - _SOFT <= value <= highest + _SOFT:
            raise ValueError(
                f'start joints: {name} at {value:g}; allowed: {lowest:.4g} ... {highest:.4g}'
            )
        start.positions[place] = value
        start.velocities[int(joint.dofadr[0])] = 0.0


def _read_joint_velocities(given: Any, task: Task, start: StartState) -> None:
    for name, value in _by_joint('joint_velocities', given, task).items():
        _require_within(f'joint_velocities of {name}', np.array([value]), _FASTEST)
        start.velocities[int(task.model.joint(name).dofadr[0])] = value


def _read_object_pose(given: Any, task: Task, start: StartState) -> None:
    place, speed = _object_places(task)
    pose = _numbers('object_pose', given, 7)
    _require_within('object_pose', pose[:3], _FARTHEST)
    length = float(np.linalg.norm(pose[3:]))
    if not length > 1e-6:
        raise ValueError('start object_pose has a quaternion of zeros; allowed: another one')
    pose[3:] /= length
    start.positions.update(zip(range(place, place + 7), pose.tolist(), strict=True))
    start.velocities.update(dict.fromkeys(range(speed, speed + 6), 0.0))


def _read_object_velocity(given: Any, task: Task, start: StartState) -> None:
    place, speed = _object_places(task)
    velocity = _numbers('object_velocity', given, 6)
    _require_within('object_velocity', velocity, _FASTEST)
    if place not in start.positions:
        raise ValueError('start object_velocity without object_pose; allowed: both, or the pose')
    # MuJoCo has the angular velocity of a free joint in the axes of the object.
    quaternion = np.array([start.positions[place + 3 + i] for i in range(4)])
    velocity[3:] = quaternion_to_matrix(quaternion).T @ velocity[3:]
    start.velocities.update(zip(range(speed, speed + 6), velocity.tolist(), strict=True))


def _object_places(task: Task) -> tuple[int, int]:
    """Return where the object's pose and velocity begin in `qpos` and `qvel`."""
    joint = free_joint(task.model)
    if joint is None:
        raise ValueError(f'start: {task.spec.name} has no object; allowed: {_listed(PARTS[:2])}')
    return int(task.model.jnt_qposadr[joint]), int(task.model.jnt_dofadr[joint])


def _numbers(name: str, given: Any, count: int) -> Array:
    """Return finite numbers (count,), a fresh array."""
    try:
        values = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        plural = 's' if count > 1 else ''
        raise ValueError(
            f'start {name}={one_line(given, 60)}; allowed: {count} finite number{plural}'
        )
    return values


def _require_within(name: str, values: Array, limit: float) -> None:
    if np.abs(values).max() > limit:
        raise ValueError(f'start {name}={values.tolist()}; allowed: {-limit:g} ... {limit:g} each')


def _require_apart(start: StartState, task: Task) -> None:
    """Raise a `ValueError` if placed bodies are inside others."""
    data = task.new_data(task.start_state)
    start.write(data.qpos, data.qvel)
    mujoco.mj_forward(task.model, data)
    model, joint = task.model, free_joint(task.model)
    # The task places an object that is not given, after this check.
    elsewhere = set()
    if joint is not None and int(model.jnt_qposadr[joint]) not in start.positions:
        elsewhere = {int(model.jnt_bodyid[joint])}
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        if contact.dist < -_DEEPEST and not elsewhere & set(bodies):
            first, second = (model.body(body).name for body in bodies)
            raise ValueError(
                f'start: {first} and {second} would overlap by {-1e3 * contact.dist:.0f} mm; '
                f'allowed: up to {1e3 * _DEEPEST:g} mm'
            )
