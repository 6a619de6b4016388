"""Pushing a robot or its object from the page."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.messages import LatestRequest, Push, Request
from msgs_spec.tasks import TaskSpec

Send = Callable[[Request | LatestRequest], None]


def pushable_bodies(spec: TaskSpec) -> list[str]:
    """Names of bodies that are worth pushing, the object first."""
    found = [spec.object_name] if spec.object_name else []
    return [*found, 'robot0:gripper_link' if spec.robot.has_gripper_command else 'robot0:palm']


class PushPanel:
    """A body, a force, and a button that pushes while it is held."""

    def __init__(self, send: Send) -> None:
        """Takes who gets the pushes."""
        self._send = send
        self._body = 0
        self._force = np.zeros(3)

    def draw(self, spec: TaskSpec, limit: float) -> None:
        """Draws the panel.

        Args:
            spec: The task.
            limit: Largest force, N.
        """
        bodies = pushable_bodies(spec)
        imgui.SetNextItemWidth(210.0)
        self._body = imgui.Combo('body', min(self._body, len(bodies) - 1), bodies)[1]
        for axis, name in enumerate('xyz'):
            imgui.SetNextItemWidth(210.0)
            value = float(self._force[axis])
            self._force[axis] = imgui.SliderFloat(f'{name} (N)', value, -limit, limit)[1]
        length = float(np.linalg.norm(self._force))
        imgui.Button(f'Push with {min(length, limit):.1f} N while held')
        if imgui.IsItemActive() and length > 0.0:
            # A hair within the limit, whatever rounding does.
            force = self._force * min(1.0, 0.999 * limit / length)
            wrench = np.concatenate([force, np.zeros(3)])
            self._send(Push(bodies[self._body], wrench))
