"""How far the goal is, as additional inputs of actor and critic.

A function of observation and goal alone, so an actor with these inputs sees no more than one
without them; it only need not learn to multiply quaternions.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from msgs_spec.tasks import GoalKind, TaskSpec

GOAL_FEATURES = ('plain', 'relative')

# Near the goal the difference is magnified until the success threshold is about one half, and
# clipped as normalised inputs are (paper, appendix B).
_CLIP = 5.0
_ROTATION_SCALE = 10.0
_POSITION_SCALES = {GoalKind.POINT: 10.0, GoalKind.POSE: 50.0, GoalKind.FINGERTIPS: 50.0}


@dataclass(frozen=True, slots=True)
class RelativeGoal:
    """The difference between the desired goal and the achieved one, in the world frame.

    Positions: 10 (Fetch) or 50 (hand) times the difference, clipped to +-5; for points also the
    difference itself, because Fetch goals lie further away than the clip. Rotations: goal
    quaternion times conjugate of the object's with its sign, because the `gymnasium` success rule
    tells q from -q, and 10 times its vector part, clipped. For the pen, whose rotation about its
    own axis does not count, the cross and dot products of the two axes take the place of the
    quaternion. Parts that do not count for the task are zero, so that tasks of one object share
    their networks.

    Attributes:
        goal: What the goals are.
        start: Index of the achieved goal in the observation.
        position_counts: Whether the position of a pose goal counts.
        ignores_z_rotation: Whether the rotation about the object's own z axis does not count.
    """

    goal: GoalKind
    start: int
    position_counts: bool = True
    ignores_z_rotation: bool = False

    @property
    def size(self) -> int:
        """Number of features."""
        return {GoalKind.POINT: 6, GoalKind.FINGERTIPS: 15, GoalKind.POSE: 10}[self.goal]

    def __call__(self, observation: Tensor, goal: Tensor) -> Tensor:
        """Features (..., size) of observations and goals in the units of the task."""
        achieved = observation[..., self.start : self.start + self.goal.size]
        scale = _POSITION_SCALES[self.goal]
        if self.goal is not GoalKind.POSE:
            difference = goal - achieved
            near = (scale * difference).clamp(-_CLIP, _CLIP)
            return torch.cat([difference, near], -1) if self.goal is GoalKind.POINT else near
        difference = goal[..., :3] - achieved[..., :3]
        position = (scale * difference).clamp(-_CLIP, _CLIP) * float(self.position_counts)
        rotation = _axis_turn if self.ignores_z_rotation else _relative_quaternion
        scalar, vector = rotation(achieved[..., 3:], goal[..., 3:])
        near = (_ROTATION_SCALE * vector).clamp(-_CLIP, _CLIP)
        return torch.cat([scalar, vector, near, position], -1)


def relative_goal(spec: TaskSpec) -> RelativeGoal:
    """Returns the relative features of a task."""
    return RelativeGoal(
        spec.goal, spec.achieved_goal_start, spec.position_counts, spec.ignores_z_rotation
    )


def _relative_quaternion(achieved: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Real part (..., 1) and vector part (..., 3) of goal times conjugate of achieved, wxyz."""
    real, vector = achieved[..., :1], achieved[..., 1:]
    goal_real, goal_vector = goal[..., :1], goal[..., 1:]
    scalar = (achieved * goal).sum(-1, keepdim=True)
    cross = torch.linalg.cross(goal_vector, vector)
    return scalar, real * goal_vector - goal_real * vector - cross


def _axis_turn(achieved: Tensor, goal: Tensor) -> tuple[Tensor, Tensor]:
    """Dot (..., 1) and cross product (..., 3) of the z axes of two quaternions wxyz."""
    first, second = _z_axis(achieved), _z_axis(goal)
    return (first * second).sum(-1, keepdim=True), torch.linalg.cross(first, second)


def _z_axis(quaternion: Tensor) -> Tensor:
    w, x, y, z = quaternion.unbind(-1)
    return torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)
