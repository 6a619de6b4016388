"""Drag a goal with the mouse: move points, turn or move poses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fetch_hand_sim.simulation.scene import ghost_pose
from fetch_hand_sim.view.page.ray import Ray
from msgs_spec.arrays import Array
from msgs_spec.rotations import quaternion_from_axis_angle, quaternion_multiply
from msgs_spec.tasks import GoalKind, TaskSpec

# Largest distance between mouse and goal to grab it, metres.
_REACH = {GoalKind.POINT: 0.035, GoalKind.FINGERTIPS: 0.009, GoalKind.POSE: 0.045}
# Rotation of a ghost while the mouse crosses the whole picture, rad.
_TURN = 2.0 * np.pi
_Z = np.array([0.0, 0.0, 1.0])
_ON_THE_TABLE = ('FetchPush', 'FetchSlide')


@dataclass(frozen=True, slots=True)
class Handle:
    """The `index`-th point of a goal, which the mouse can grab, and its drawn position (3,), m."""

    index: int
    position: Array


def handles(spec: TaskSpec, goal: Array) -> list[Handle]:
    """Return the points of a goal that the mouse can grab; a pose has one, its drawn position."""
    if spec.goal is GoalKind.POSE:
        return [Handle(0, ghost_pose(spec, goal)[:3])]
    return [Handle(index, point) for index, point in enumerate(goal.reshape(-1, 3))]


def find_handle(spec: TaskSpec, goal: Array, ray: Ray) -> Handle | None:
    """Return the handle nearest to the ray under the mouse; None if it is beyond `_REACH`, m."""
    nearest = min(handles(spec, goal), key=lambda each: ray.distance_to(each.position))
    return nearest if ray.distance_to(nearest.position) < _REACH[spec.goal] else None


def moved_goal(
    spec: TaskSpec, goal: Array, handle: Handle, ray: Ray, is_turning: bool, delta: Array
) -> Array:
    """Return the goal (goal size,) after the mouse has moved.

    Goals move parallel to the picture, or along the table for FetchPush and FetchSlide.

    Args:
        goal: (goal size,) the goal when the mouse grabbed `handle`.
        ray: The present ray under the mouse.
        is_turning: Whether to turn a pose, not move it; a pose without position always turns.
        delta: (2,) mouse movement since the grab, in picture widths and heights; 1 is a full turn.
    """
    if spec.goal is GoalKind.POSE and (is_turning or not spec.position_counts):
        return _turned(spec, goal, ray, delta)
    # Goals on the table stay on it; other goals move parallel to the picture.
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


def drag_hint(spec: TaskSpec) -> str:
    """Return the hint that explains how to drag the goal of a task."""
    if spec.goal is not GoalKind.POSE:
        return 'Drag the goal'
    if not spec.position_counts:
        return 'Drag to turn the goal'
    return 'Drag to turn the goal, with Shift to move it'
