"""Sliders for a goal."""

from __future__ import annotations

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.windows import ITEM_WIDTH, Send
from fetch_hand_sim.view.requests import ReleaseGoal, SetGoal
from msgs_spec.arrays import Array
from msgs_spec.rotations import euler_to_quaternion, quaternion_to_euler
from msgs_spec.tasks import GoalKind, TaskSpec

# Where goals make sense, metres: about where the tasks draw theirs.
_FETCH_RANGES = ((1.05, 1.6), (0.4, 1.1), (0.42, 0.9))
_SLIDE_RANGES = ((1.1, 2.0), (0.4, 1.1), (0.4, 0.45))
_HAND_RANGES = ((0.94, 1.06), (0.78, 0.96), (0.15, 0.32))


def position_ranges(spec: TaskSpec) -> tuple[tuple[float, float], ...]:
    """Lower and upper ends of the sliders for x, y and z, metres."""
    if not spec.robot.has_gripper_command:
        return _HAND_RANGES
    return _SLIDE_RANGES if spec.name == 'FetchSlide' else _FETCH_RANGES


def draw_goal_sliders(spec: TaskSpec, goal: Array, is_kept: bool, send: Send) -> None:
    """Draws sliders for position and rotation, as far as the task has them."""
    if spec.goal is GoalKind.FINGERTIPS:
        imgui.Text('Drag the five balls.')
    changed = goal.copy()
    if spec.goal is GoalKind.POINT or (spec.position_counts and spec.goal is GoalKind.POSE):
        for axis, (name, (lower, upper)) in enumerate(
            zip('xyz', position_ranges(spec), strict=True)
        ):
            imgui.SetNextItemWidth(ITEM_WIDTH)
            changed[axis] = imgui.SliderFloat(f'{name} (m)', float(goal[axis]), lower, upper)[1]
    if spec.goal is GoalKind.POSE:
        changed[3:] = _draw_angles(spec, goal[3:])
    if np.abs(changed - goal).max() > 1e-6:
        send(SetGoal(changed, is_kept))
    if imgui.Button('Let the task choose again'):
        send(ReleaseGoal())


def _draw_angles(spec: TaskSpec, quaternion: Array) -> Array:
    """Sliders for the angles about the world's axes; the quaternion as it was if none moved."""
    angles = quaternion_to_euler(quaternion)
    axes = (2,) if spec.name == 'HandManipulateBlockRotateZ' else (0, 1, 2)
    has_changed = False
    for axis in axes:
        imgui.SetNextItemWidth(ITEM_WIDTH)
        degrees = float(np.degrees(angles[axis]))
        moved, degrees = imgui.SliderFloat(f'about {"xyz"[axis]} (deg)', degrees, -180.0, 180.0)
        if moved:
            angles[axis], has_changed = np.radians(degrees), True
    return euler_to_quaternion(angles) if has_changed else quaternion
