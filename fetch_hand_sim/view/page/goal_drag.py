"""Dragging a goal with the mouse: points move, ghosts turn."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fetch_hand_sim.simulation.scene import ghost_pose
from fetch_hand_sim.view.page.ray import Ray
from msgs_spec.arrays import Array
from msgs_spec.rotations import quaternion_from_axis_angle, quaternion_multiply
from msgs_spec.tasks import GoalKind, TaskSpec

# How near the mouse must be to a goal to take it, metres.
_REACH = {GoalKind.POINT: 0.035, GoalKind.FINGERTIPS: 0.009, GoalKind.POSE: 0.045}
# Radians by which a ghost turns as the mouse crosses the whole picture.
_TURN = 2.0 * np.pi
_Z = np.array([0.0, 0.0, 1.0])
_ON_THE_TABLE = ('FetchPush', 'FetchSlide')


@dataclass(frozen=True, slots=True)
class Handle:
    """What of a goal the mouse is at.

    Attributes:
        index: Which point of it, from 0.
        position: (3,) where it is drawn, m.
    """

    index: int
    position: Array


def handles(spec: TaskSpec, goal: Array) -> list[Handle]:
    """The places at which a goal can be taken."""
    if spec.goal is GoalKind.POSE:
        return [Handle(0, ghost_pose(spec, goal)[:3])]
    return [Handle(index, point) for index, point in enumerate(goal.reshape(-1, 3))]


def find_handle(spec: TaskSpec, goal: Array, ray: Ray) -> Handle | None:
    """Returns the handle under the mouse, the nearest of several, or None."""
    nearest = min(handles(spec, goal), key=lambda each: ray.distance_to(each.position))
    return nearest if ray.distance_to(nearest.position) < _REACH[spec.goal] else None


def moved_goal(
    spec: TaskSpec, goal: Array, handle: Handle, ray: Ray, is_turning: bool, delta: Array
) -> Array:
    """Returns the goal after the mouse has moved.

    Args:
        spec: The task.
        goal: (goal size,) as it was when the mouse took it.
        handle: Where the mouse took it.
        ray: Under the mouse now.
        is_turning: Whether a pose turns or moves.
        delta: (2,) how far the mouse has come, in widths and heights of the picture.
    """
    if spec.goal is GoalKind.POSE and (is_turning or not spec.position_counts):
        return _turned(spec, goal, ray, delta)
    # What lies on the table stays on it; all else moves in the plane of the picture.
    normal = _Z if spec.looks_like in _ON_THE_TABLE else ray.forward
    place = ray.meets_plane(handle.position, normal)
    if place is None:
        return goal
    result = goal.copy()
    start = 3 * handle.index
    result[start : start + 3] += place - handle.position
    return result


def _turned(spec: TaskSpec, goal: Array, ray: Ray, delta: Array) -> Array:
    turn = quaternion_from_axis_angle(_Z, _TURN * delta[0])
    if spec.looks_like != 'HandManipulateBlockRotateZ':
        tilt = quaternion_from_axis_angle(ray.right, _TURN * delta[1])
        turn = quaternion_multiply(tilt, turn)
    result = goal.copy()
    result[3:] = quaternion_multiply(turn, goal[3:])
    return result
