"""Checks of arguments: errors name the argument before a library fails on it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils import seeding
from numpy.typing import ArrayLike, NDArray

from msgs_spec.arrays import Array
from msgs_spec.tasks import TaskSpec

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
