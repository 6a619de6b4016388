"""Check arguments; an error names the argument, the given value and the allowed ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from numbers import Real
from typing import Any

import mujoco
import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation.tasks import Task
from msgs_spec.arrays import Array
from msgs_spec.rotations import quaternion_to_matrix
from msgs_spec.text import entries, one_line

Seed = int | np.random.Generator | None
Seeds = int | Sequence[Seed] | None


def require_whole(name: str, value: Any, lowest: int = 0, highest: int | None = 2**31 - 1) -> None:
    """Raise ValueError unless `value` is an integer, not a boolean, from `lowest` to `highest`."""
    is_whole = isinstance(value, int | np.integer) and not isinstance(value, bool)
    if not is_whole or value < lowest or (highest is not None and value > highest):
        allowed = f'from {lowest}' if highest is None else f'{lowest} ... {highest}'
        raise ValueError(f'{name} {one_line(repr(value), 40)}; allowed: whole numbers {allowed}')


def finite_numbers(name: str, values: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.floating]:
    """Return finite numbers of this shape as an array, or raise ValueError.

    A float32 array stays float32; other numbers become float64.
    """
    try:
        array = np.asarray(values)
    except ValueError:
        # Rows of different lengths.
        array = np.array(None)
    is_number = array.dtype.kind in 'iuf'
    if array.shape != shape or not is_number:
        given = f'shape {array.shape}' if is_number else one_line(repr(values), 40)
        raise ValueError(f'{name}: {given} given; allowed: numbers of shape {shape}')
    if array.dtype not in (np.float32, np.float64):
        array = array.astype(np.float64)
    if not np.isfinite(array).all():
        place = np.argwhere(~np.isfinite(array))[0].tolist()
        raise ValueError(f'{name}{place} is {array[tuple(place)]}; allowed: finite numbers')
    return array


def nearest_quaternions(goals: Array, achieved_goals: Array) -> Array:
    """Return goal poses (n, 7) with the unit quaternions that are nearest to the achieved goals.

    Of q and -q, the same rotation, the nearer one is taken. A zero quaternion raises ValueError.
    """
    norm = np.linalg.norm(goals[:, 3:], axis=1, keepdims=True)
    if not (norm > 1e-6).all():
        raise ValueError('a goal quaternion must not be zero')
    quaternions = goals[:, 3:] / norm
    quaternions[(quaternions * achieved_goals[:, 3:]).sum(axis=1) < 0.0] *= -1.0
    return np.concatenate([goals[:, :3], quaternions], axis=1)


def each_of(name: str, given: Any, count: int) -> list[Any]:
    """Return the argument `name` as a list with one value for each of `count` simulations.

    `given` is one value for all simulations, or `count` values: a list, a tuple or the rows of an
    array. Values may be None. Another number of values raises ValueError. If `name` is `goal`, a
    list of numbers is one goal for all simulations.
    """
    is_list = isinstance(given, list | tuple)
    if is_list and name == 'goal':
        is_list = not all(isinstance(part, Real) for part in given)
    is_rows = isinstance(given, np.ndarray) and given.ndim == 2
    each = list(given) if is_list or is_rows else [given] * count
    if len(each) != count:
        raise ValueError(f'{name}: {len(each)} values; allowed: one, or {count}')
    return each


def selected_simulations(ids: ArrayLike, num_envs: int) -> NDArray[np.intp]:
    """Return the indices of simulations in `ids`: distinct indices or a boolean mask (N,).

    Other values of `ids` raise ValueError. The result keeps the order of the indices.
    """
    selected = np.asarray(ids)
    if selected.dtype == bool and selected.shape == (num_envs,):
        return np.flatnonzero(selected)
    is_index = selected.ndim == 1 and (selected.dtype.kind in 'iu' or not selected.size)
    if (
        not is_index
        or not set(selected.tolist()) <= set(range(num_envs))
        or (np.unique(selected).size != selected.size)
    ):
        raise ValueError(
            f'ids {one_line(repr(ids), 40)}; allowed: distinct indices below {num_envs} or a '
            f'boolean mask of shape ({num_envs},)'
        )
    return selected.astype(np.intp)


def generators(seed: Seeds, selected: NDArray[np.intp]) -> list[np.random.Generator | None]:
    """Return a random generator for each selected simulation, or None where no seed is given.

    `seed` is one integer (simulation i takes `seed` + i), a list with an integer, a generator or
    None for each selected simulation, or None for all. Invalid seeds raise ValueError.
    """
    if seed is None:
        return [None] * selected.size
    if np.ndim(seed) == 0:  # type: ignore[arg-type]
        require_whole('seed', seed, highest=None)
        seed = [seed + int(i) for i in selected]  # type: ignore[operator]
    each: list[Any] = list(seed)  # type: ignore[arg-type]
    if len(each) != selected.size:
        raise ValueError(f'{len(each)} seeds for {selected.size} simulations')
    for place, value in enumerate(each):
        if not isinstance(value, np.random.Generator | None):
            require_whole('seed', value, highest=None)
            each[place] = seeding.np_random(int(value))[0]
    return each


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
    """Start values of some coordinates, by their index in `qpos` or `qvel`."""

    positions: dict[int, float] = field(default_factory=dict)
    velocities: dict[int, float] = field(default_factory=dict)

    def write(self, qpos: Array, qvel: Array) -> None:
        """Write the values into `qpos` (nq,) and `qvel` (nv,) of one simulation; keep others."""
        for row, values in ((qpos, self.positions), (qvel, self.velocities)):
            row[list(values)] = list(values.values())


def read_start(given: Any, task: Task) -> StartState:
    """Return the start state that `start` of `Simulation.reset` describes, or raise ValueError."""
    parts, start = entries('start', given, PARTS), StartState()
    settled = task.new_data(task.start_state).qpos
    for name, value in _by_joint('joints', parts, task).items():
        joint = task.model.joint(name)
        place = int(joint.qposadr[0])
        lowest, highest = joint.range if joint.limited else (-_FARTHEST, _FARTHEST)
        # The settled torso of Fetch is below its range.
        lowest = min(lowest, float(settled[place]))
        _require_within(f'joints {name}', value, lowest - _SOFT, highest + _SOFT)
        start.positions[place] = value
        start.velocities[int(joint.dofadr[0])] = 0.0
    for name, value in _by_joint('joint_velocities', parts, task).items():
        _require_within(f'joint_velocities {name}', value, -_FASTEST, _FASTEST)
        start.velocities[int(task.model.joint(name).dofadr[0])] = value
    if 'object_pose' in parts or 'object_velocity' in parts:
        _read_object(parts, task, start)
    if start.positions:
        _require_apart(start, task)
    return start


def _by_joint(part: str, parts: Mapping[str, Any], task: Task) -> dict[str, float]:
    """Return the entry `part` by joint name, {} if missing; ValueError if it is invalid."""
    joints, given = task.spec.robot.joints, parts.get(part, {})
    if not isinstance(given, Mapping):
        values = finite_numbers(f'start {part}', given, (len(joints),))
        return dict(zip(joints, values.tolist(), strict=True))
    named = entries(f'start {part} of {task.spec.name}', given, joints)
    return {
        name: float(finite_numbers(f'start {part} {name}', value, ()))
        for name, value in named.items()
    }


def _read_object(parts: Mapping[str, Any], task: Task, start: StartState) -> None:
    if task.object_qpos is None or task.object_qvel is None:
        raise ValueError(f'start: {task.spec.name} has no object; allowed: {", ".join(PARTS[:2])}')
    if 'object_pose' not in parts:
        raise ValueError('start object_velocity without object_pose; allowed: both, or the pose')
    pose = np.array(finite_numbers('start object_pose', parts['object_pose'], (7,)), np.float64)
    given = finite_numbers('start object_velocity', parts.get('object_velocity', np.zeros(6)), (6,))
    velocity = np.array(given, np.float64)
    _require_within('object_pose', pose[:3], -_FARTHEST, _FARTHEST)
    _require_within('object_velocity', velocity, -_FASTEST, _FASTEST)
    length = float(np.linalg.norm(pose[3:]))
    if not length > 1e-6:
        raise ValueError('start object_pose has a quaternion of zeros; allowed: another one')
    pose[3:] /= length
    # MuJoCo has the angular velocity of a free joint in the axes of the object.
    velocity[3:] = quaternion_to_matrix(pose[3:]).T @ velocity[3:]
    start.positions.update(enumerate(pose.tolist(), task.object_qpos.start))
    start.velocities.update(enumerate(velocity.tolist(), task.object_qvel.start))


def _require_within(name: str, values: ArrayLike, lowest: float, highest: float) -> None:
    if not (lowest <= np.min(values) and np.max(values) <= highest):
        raise ValueError(
            f'start {name}: {one_line(values, 60)} given; allowed: {lowest:.4g} ... {highest:.4g}'
        )


def _require_apart(start: StartState, task: Task) -> None:
    """Raise ValueError if bodies overlap by over 5 mm; ignore an object without a given pose."""
    data, model = task.new_data(task.start_state), task.model
    start.write(data.qpos, data.qvel)
    mujoco.mj_forward(model, data)
    elsewhere = set()
    if task.object_qpos is not None and task.object_qpos.start not in start.positions:
        # The task places an object that is not given, after this check.
        elsewhere = {model.body(task.spec.object_name).id}
    for contact in data.contact:
        bodies = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        if contact.dist < -_DEEPEST and not elsewhere & set(bodies):
            first, second = (model.body(body).name for body in bodies)
            raise ValueError(
                f'start: {first} and {second} would overlap by {-1e3 * contact.dist:.0f} mm; '
                f'allowed: up to {1e3 * _DEEPEST:g} mm'
            )
