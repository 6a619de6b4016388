"""Draw sliders with which the user sets a goal."""

from __future__ import annotations

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.widgets import ITEM_WIDTH, Send
from fetch_hand_sim.view.requests import ReleaseGoal, SetGoal
from msgs_spec.arrays import Array
from msgs_spec.rotations import euler_to_quaternion, quaternion_to_euler
from msgs_spec.tasks import GoalKind, TaskSpec

# Ranges of useful goals, metres: about those of the tasks.
_FETCH_RANGES = ((1.05, 1.6), (0.4, 1.1), (0.42, 0.9))
_SLIDE_RANGES = ((1.1, 2.0), (0.4, 1.1), (0.4, 0.45))
_HAND_RANGES = ((0.94, 1.06), (0.78, 0.96), (0.15, 0.32))
# Reach of the fingertips, metres.
_FINGERTIP_RANGES = ((0.87, 1.12), (0.76, 0.96), (0.06, 0.27))
# In the order of `msgs_spec.FINGERTIPS`.
_FINGERS = ('first finger', 'middle finger', 'ring finger', 'little finger', 'thumb')


def position_ranges(spec: TaskSpec) -> tuple[tuple[float, float], ...]:
    """Return limits (lower, upper) of the sliders for x, y and z, m, close to those of goals."""
    if spec.goal is GoalKind.FINGERTIPS:
        return _FINGERTIP_RANGES
    if not spec.robot.has_gripper_command:
        return _HAND_RANGES
    return _SLIDE_RANGES if spec.looks_like == 'FetchSlide' else _FETCH_RANGES


class GoalPanel:
    """The part of the robot panel with which the user sets the goal.

    Attributes:
        keeps_goal: Whether later episodes use the goal set here, too.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._finger = 0
        self.keeps_goal = True

    def draw(self, spec: TaskSpec, goal: Array) -> None:
        """Draw sliders for a goal (goal size,), and send the new goal if the user moves one."""
        self.keeps_goal = imgui.Checkbox('Keep my goal in new episodes', self.keeps_goal)[1]
        changed = goal.copy()
        if spec.goal is GoalKind.FINGERTIPS:
            imgui.SetNextItemWidth(ITEM_WIDTH)
            self._finger = imgui.Combo('finger', self._finger, list(_FINGERS))[1]
            _draw_position(spec, changed[3 * self._finger : 3 * self._finger + 3])
        elif spec.position_counts or spec.goal is GoalKind.POINT:
            _draw_position(spec, changed[:3])
        if spec.goal is GoalKind.POSE:
            changed[3:] = _draw_angles(spec, goal[3:])
        if np.abs(changed - goal).max() > 1e-6:
            self._send(SetGoal(changed, self.keeps_goal))
        if imgui.Button('Let the task choose again'):
            self._send(ReleaseGoal())


def _draw_position(spec: TaskSpec, position: Array) -> None:
    """Draw sliders for x, y and z and write their values into `position` (3,), metres."""
    for axis, (lower, upper) in enumerate(position_ranges(spec)):
        imgui.SetNextItemWidth(ITEM_WIDTH)
        name, value = f'{"xyz"[axis]} (m)', float(position[axis])
        position[axis] = imgui.SliderFloat(name, value, lower, upper)[1]


def _draw_angles(spec: TaskSpec, quaternion: Array) -> Array:
    """Draw sliders for Euler angles; return the new quaternion, wxyz, or the old one if unmoved."""
    angles = quaternion_to_euler(quaternion)
    axes = (2,) if spec.looks_like == 'HandManipulateBlockRotateZ' else (0, 1, 2)
    has_changed = False
    for axis in axes:
        imgui.SetNextItemWidth(ITEM_WIDTH)
        degrees = float(np.degrees(angles[axis]))
        # Beyond 90 degrees about y, the other angles of the same rotation would jump.
        end = 90.0 if axis == 1 else 180.0
        moved, degrees = imgui.SliderFloat(f'about {"xyz"[axis]} (deg)', degrees, -end, end)
        if moved:
            angles[axis], has_changed = np.radians(degrees), True
    return euler_to_quaternion(angles) if has_changed else quaternion
