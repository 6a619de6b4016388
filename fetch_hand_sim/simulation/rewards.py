"""Goal distances, success rules and rewards: pure functions of goals of any batch shape.

Hindsight replay replaces goals after an episode, so these functions do not use the simulation. Sums
run in a fixed order, so a batch gives the same bits as one call per row.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.arrays import Array
from msgs_spec.robots import FINGERTIPS
from msgs_spec.rotations import euler_to_quaternion, quaternion_to_euler, rotation_angle
from msgs_spec.tasks import REWARD_TYPES, SUCCESS_RULES, GoalKind, RewardType, SuccessRule, TaskSpec
from msgs_spec.text import one_of


def _norm(difference: Array) -> Array:
    """Return Euclidean norms over the last axis; the order of the sum is fixed."""
    total = np.zeros(difference.shape[:-1])
    for index in range(difference.shape[-1]):
        part = difference[..., index]
        total = total + part * part
    return np.asarray(np.sqrt(total))


# Without slots, so that copies and pickles keep further attributes of subclasses.
@dataclass(frozen=True)
class GoalMetric:
    """Computes goal distances, success and rewards of a task.

    A subclass may have more fields or attributes; `with_changes` keeps them.

    Attributes:
        spec: The task.
        success_rule: `gymnasium` follows the released code (HandReach: norm over all 15
            coordinates; rotations: raw quaternions, so q and -q are 2 pi apart). `paper` follows
            the text of Plappert et al. 2018 (mean fingertip distance; rotation difference).
        reward_type: `sparse` is -1 or 0; `dense` is the negative distance.
    """

    spec: TaskSpec
    success_rule: SuccessRule = 'gymnasium'
    reward_type: RewardType = 'sparse'

    def __post_init__(self) -> None:
        one_of(self.success_rule, SUCCESS_RULES, 'success_rule')
        one_of(self.reward_type, REWARD_TYPES, 'reward_type')

    def with_changes(self, **changes: Any) -> Self:
        """Return a copy with new values of some fields.

        `dataclasses.replace` would call `__init__` and lose further attributes of subclasses.
        """
        changed = copy.copy(self)
        for name, value in changes.items():
            object.__setattr__(changed, name, value)
        changed.__post_init__()
        return changed

    @property
    def has_own_reward(self) -> bool:
        """True if a subclass overrides `reward`."""
        return type(self).reward is not GoalMetric.reward

    def distances(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> tuple[Array, Array]:
        """Return distances (...), m, and rotations (...), rad, between goals (..., goal size).

        Distance or rotation is zero if the task ignores it. Wrong shapes raise ValueError.
        """
        achieved = self._checked('achieved_goal', achieved_goal)
        desired = self._checked('desired_goal', desired_goal)
        if achieved.shape != desired.shape:
            raise ValueError(
                f'achieved_goal {achieved.shape} and desired_goal {desired.shape} differ in shape'
            )
        nothing = np.zeros(achieved.shape[:-1])
        if self.spec.goal is GoalKind.POSE:
            place = achieved[..., :3] - desired[..., :3]
            distance = _norm(place) if self.spec.position_counts else nothing
            return distance, self._rotation(achieved, desired)
        if self.spec.goal is GoalKind.FINGERTIPS and self.success_rule == 'paper':
            # Not -1, which fails for an empty batch.
            fingertips = (achieved - desired).reshape(*achieved.shape[:-1], len(FINGERTIPS), 3)
            per_fingertip = np.moveaxis(_norm(fingertips), -1, 0)
            return np.asarray(sum(per_fingertip) / len(per_fingertip)), nothing
        return _norm(achieved - desired), nothing

    def success(self, achieved_goal: ArrayLike, desired_goal: ArrayLike) -> NDArray[np.bool_]:
        """Return whether goals (..., goal size) are reached, a boolean array (...)."""
        return self._success(*self.distances(achieved_goal, desired_goal))

    def reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any = None) -> Array:
        """Return the reward (...) of goals (..., goal size).

        Sparse: 0 where the goal is reached, -1 elsewhere. Dense: minus the distance, m; for poses
        minus (10 x distance + rotation), m and rad, as in `manipulate.py` of Gymnasium-Robotics.
        `info` is ignored; it is part of Gymnasium's signature.
        """
        del info
        return self._reward(*self.distances(achieved_goal, desired_goal))

    def evaluate(
        self, achieved_goal: ArrayLike, desired_goal: ArrayLike
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Return reward and success of goals (..., goal size), computing distances once.

        If a subclass overrides `success` or `reward`, this method calls them. Steps and relabelled
        transitions therefore get the same rewards.
        """
        if self.has_own_reward or type(self).success is not GoalMetric.success:
            reward = self.reward(achieved_goal, desired_goal)
            return reward, self.success(achieved_goal, desired_goal)
        distances = self.distances(achieved_goal, desired_goal)
        return self._reward(*distances), self._success(*distances)

    def _success(self, distance: Array, rotation: Array) -> NDArray[np.bool_]:
        reached = distance < self.spec.distance_threshold
        if self.spec.rotation_threshold is not None:
            reached = reached & (rotation < self.spec.rotation_threshold)
        return np.asarray(reached)

    def _reward(self, distance: Array, rotation: Array) -> Array:
        if self.reward_type == 'dense':
            return -(10.0 * distance + rotation) if self.spec.goal is GoalKind.POSE else -distance
        if self.spec.rotation_threshold is None:
            # A goal exactly on the threshold is no success but has reward 0, as in the reference.
            return -(~(distance <= self.spec.distance_threshold)).astype(np.float64)
        return self._success(distance, rotation).astype(np.float64) - 1.0

    def _checked(self, name: str, goal: ArrayLike) -> Array:
        size = self.spec.goal.size
        try:
            values = np.ascontiguousarray(goal, dtype=np.float64)
        except (TypeError, ValueError):
            raise ValueError(
                f'{name} {goal!r:.60}; allowed: numbers (..., {size}) for {self.spec.name}'
            ) from None
        if values.ndim == 0 or values.shape[-1] != size:
            raise ValueError(
                f'{name} of {self.spec.name} has {size} values on its last axis, not shape '
                f'{np.shape(goal)}'
            )
        return values

    def _rotation(self, achieved: Array, desired: Array) -> Array:
        quaternion = achieved[..., 3:]
        if self.spec.ignores_z_rotation:
            euler = quaternion_to_euler(quaternion)
            euler[..., 2] = quaternion_to_euler(desired[..., 3:])[..., 2]
            quaternion = euler_to_quaternion(euler)
        return rotation_angle(quaternion, desired[..., 3:], antipodal=self.success_rule == 'paper')
