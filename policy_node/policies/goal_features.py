"""Compute network inputs with the difference to the goal and the symmetry of the object.

The inputs are functions of observation and goal alone and add no information. They spare the
network from learning quaternion products and symmetries. The same functions serve NumPy arrays
(running actors) and torch tensors (training).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from operator import add
from types import ModuleType
from typing import Any

import numpy as np

from msgs_spec.tasks import GoalKind, TaskSpec
from msgs_spec.text import one_of

# A NumPy array or a torch tensor; functions return the same kind.
Array = Any
# Observation (..., observation size) and goal (..., goal size).
Seen = tuple[Array, Array]

GOAL_FEATURES = ('plain', 'relative', 'symmetric')

# Near the goal the difference is magnified until the success threshold is about one half, and
# clipped as normalised inputs are (paper, appendix B).
_CLIP = 5.0
_ROTATION_SCALE = 10.0
# World frame; its standard deviation in a run is about 2 rad/s.
_ANGULAR_VELOCITY_SCALE = 0.5
_POSITION_SCALES = {GoalKind.POINT: 10.0, GoalKind.POSE: 50.0, GoalKind.FINGERTIPS: 50.0}


@dataclass(frozen=True, slots=True)
class RelativeGoal:
    """The difference between the desired goal and the achieved one, in the world frame.

    - Positions: 10 (Fetch) or 50 (hand) times the difference, clipped to +-5. Points also have the
      plain difference, because Fetch goals lie further away than the clip.
    - Rotations: the quaternion from the achieved to the desired goal, and 10 times its vector part,
      clipped. The quaternion keeps its sign, because the `gymnasium` success rule distinguishes q
      from -q.
    - Pen: rotations about the pen's own axis do not count. Dot and cross product of the pen's
      achieved and desired axis replace the quaternion.

    Parts that do not count for the task are zero. So tasks with the same object can share networks.

    Attributes:
        goal: Kind of the goal: a point, fingertips or a pose.
        start: Index of the achieved goal in the observation.
        position_counts: Whether the position of a pose goal counts.
        ignores_z_rotation: Whether rotations about the object's own z axis do not count.
    """

    goal: GoalKind
    start: int
    position_counts: bool = True
    ignores_z_rotation: bool = False

    def inputs(self, seen: Seen, normalized: Seen) -> Array:
        """Return normalised observation, normalised goal and `difference`, concatenated.

        Args:
            seen: Observation and goal, (..., size) each, in the units of the task.
            normalized: The same observation and goal, normalised.
        """
        return concatenate(*normalized, self.difference(*seen))

    def goal_position(self, observation_size: int, size: int) -> list[int]:
        """Return the indices of the network inputs that depend on the position of a pose goal.

        `size` is the number of inputs, without past actions.
        """
        return [*range(observation_size, observation_size + 3), *range(size - 3, size)]

    def difference(self, observation: Array, goal: Array) -> Array:
        """Return inputs for the difference of the goals; arguments are in the task's units.

        The shape is (..., 6) for a point, (..., 15) for fingertips and (..., 10) for a pose.
        """
        achieved = observation[..., self.start : self.start + self.goal.size]
        scale = _POSITION_SCALES[self.goal]
        if self.goal is not GoalKind.POSE:
            difference = goal - achieved
            near = (scale * difference).clip(-_CLIP, _CLIP)
            return concatenate(difference, near) if self.goal is GoalKind.POINT else near
        difference = goal[..., :3] - achieved[..., :3]
        position = (scale * difference).clip(-_CLIP, _CLIP) * float(self.position_counts)
        rotation = _axis_turn if self.ignores_z_rotation else _relative_quaternion
        scalar, vector = rotation(achieved[..., 3:], goal[..., 3:])
        near = (_ROTATION_SCALE * vector).clip(-_CLIP, _CLIP)
        return concatenate(scalar, vector, near, position)


@dataclass(frozen=True, slots=True)
class SymmetricObject:
    """Inputs that are equal for poses of an object that differ only by its symmetry.

    A cube looks the same on another face. An egg or a pen looks the same when turned about its axis
    or upside down. Polynomials of the rotation matrix replace the object's quaternion. They are
    equal for rotations that look the same and differ for others. A cube has the sum of the fourth
    tensor powers of its three axes, a body of revolution the second tensor power of its axis. The
    angular velocity is in the world frame. The desired goal appears only in `relative.difference`.

    Attributes:
        symmetry: `cube`, or `revolution` for a body of revolution that can be turned upside down.
    """

    relative: RelativeGoal
    symmetry: str

    def inputs(self, seen: Seen, normalized: Seen) -> Array:
        """Return the network inputs; the class docstring describes the replaced values.

        Args:
            seen: Observation and goal, (..., size) each, in the units of the task. The observation
                ends with the object's velocity and pose.
            normalized: The same observation and goal, normalised.
        """
        (observation, goal), (normalized_observation, _) = seen, normalized
        start = self.relative.start
        rotation = _rotation_matrix(observation[..., start + 3 : start + 7])
        angular_velocity = (rotation @ observation[..., start - 3 : start, None]).squeeze(-1)
        shape = _cube_shape(rotation) if self.symmetry == 'cube' else _axis_shape(rotation)
        return concatenate(
            normalized_observation[..., : start - 3],
            normalized_observation[..., start : start + 3],
            (_ANGULAR_VELOCITY_SCALE * angular_velocity).clip(-_CLIP, _CLIP),
            shape,
            self.relative.difference(observation, goal),
        )

    def goal_position(self, observation_size: int, size: int) -> list[int]:
        """Return the indices of the last 3 of `size` inputs; they depend on the goal's position."""
        del observation_size
        return [*range(size - 3, size)]


GoalFeatures = RelativeGoal | SymmetricObject
"""Makes network inputs from an observation and a goal."""


def goal_features(kind: str, spec: TaskSpec) -> GoalFeatures | None:
    """Return the object that makes the network inputs of a task, or None for `plain`.

    `plain` inputs are observation and goal. `relative` gives a `RelativeGoal`, `symmetric` a
    `SymmetricObject`. Another `kind` raises ValueError; so does `symmetric` if the goal of the task
    is no object pose.
    """
    if one_of(kind, GOAL_FEATURES, 'goal_features') == 'plain':
        return None
    relative = RelativeGoal(
        spec.goal, spec.achieved_goal_start, spec.position_counts, spec.ignores_z_rotation
    )
    if kind == 'relative':
        return relative
    if spec.object_symmetry is None:
        raise ValueError(
            f'goal_features symmetric is not possible: the goal of {spec.name} is no object pose'
        )
    return SymmetricObject(relative, spec.object_symmetry)


def _rotation_matrix(quaternion: Array) -> Array:
    """Return the matrices (..., 3, 3) of unit quaternions wxyz."""
    w, x, y, z = _parts(quaternion)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    stack = _library(quaternion).stack
    return stack([stack(row, -1) for row in rows], -2)


def _cube_shape(rotation: Array) -> Array:
    """Return 15 sums of a_i a_j a_k a_l over the columns a of matrices, scaled to about +-1."""
    second = _second_powers(rotation)
    xx, xy, xz, yy, yz, zz = (second[..., i, :] for i in range(6))
    products = [xx * second[..., i, :] for i in range(6)]
    products += [yy * part for part in (xy, xz, yy, yz, zz)]
    products += [zz * part for part in (xy, xz, yz, zz)]
    sums = _library(rotation).stack([reduce(add, _parts(product)) for product in products], -1)
    # Means over all rotations: 3/5 of fourth powers, 3/15 of products of two squares.
    means = _like(sums, [0.6, 0, 0, 0.2, 0, 0.2, 0, 0, 0.6, 0, 0.2, 0, 0, 0, 0.6])
    return 3.0 * (sums - means)


def _axis_shape(rotation: Array) -> Array:
    """Return 6 products a_i a_j of the last column a of matrices, scaled to about +-1."""
    second = _second_powers(rotation[..., 2:]).squeeze(-1)
    return 1.5 * (second - _like(second, [1 / 3, 0, 0, 1 / 3, 0, 1 / 3]))


def _second_powers(axes: Array) -> Array:
    """Return xx, xy, xz, yy, yz, zz (..., 6, n) of the columns of (..., 3, n)."""
    x, y, z = (axes[..., i, :] for i in range(3))
    return _library(axes).stack([x * x, x * y, x * z, y * y, y * z, z * z], -2)


def _relative_quaternion(achieved: Array, goal: Array) -> tuple[Array, Array]:
    """Return real (..., 1) and vector part (..., 3) of goal times conjugate of achieved, wxyz."""
    real, vector = achieved[..., :1], achieved[..., 1:]
    goal_real, goal_vector = goal[..., :1], goal[..., 1:]
    scalar = (achieved * goal).sum(-1)[..., None]
    return scalar, real * goal_vector - goal_real * vector - _cross(goal_vector, vector)


def _axis_turn(achieved: Array, goal: Array) -> tuple[Array, Array]:
    """Return dot (..., 1) and cross product (..., 3) of the z axes of two rotations wxyz."""
    first, second = _z_axis(achieved), _z_axis(goal)
    return (first * second).sum(-1)[..., None], _cross(first, second)


def _z_axis(quaternion: Array) -> Array:
    w, x, y, z = _parts(quaternion)
    axis = [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)]
    return _library(quaternion).stack(axis, -1)


def _library(array: Array) -> ModuleType:
    """Return `numpy` or `torch`, the library of an array; both have the functions used here."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def concatenate(*parts: Array) -> Array:
    """Concatenate along the last axis."""
    return _library(parts[0]).concatenate(parts, -1)


def _like(array: Array, values: list[float]) -> Array:
    """Return `values` as an array with the library, data type and device of `array`."""
    return np.asarray(values) if isinstance(array, np.ndarray) else array.new_tensor(values)


def _parts(array: Array) -> list[Array]:
    """Split an array along its last axis into arrays without this axis."""
    return [array[..., i] for i in range(array.shape[-1])]


def _cross(first: Array, second: Array) -> Array:
    """Return the cross product of vectors (..., 3)."""
    library = _library(first)
    return np.cross(first, second) if library is np else library.linalg.cross(first, second)
