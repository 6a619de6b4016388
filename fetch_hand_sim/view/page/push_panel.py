"""Pushing a robot or its object from the page."""

from __future__ import annotations

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.windows import ITEM_WIDTH, Send
from fetch_hand_sim.view.requests import Push
from msgs_spec.tasks import TaskSpec


def pushable_bodies(spec: TaskSpec) -> list[str]:
    """Names of bodies that are worth pushing, the object first."""
    found = [spec.object_name] if spec.object_name else []
    return [*found, 'robot0:gripper_link' if spec.robot.has_gripper_command else 'robot0:palm']


class PushPanel:
    """A body, a force, and a button that pushes while it is held.

    Args:
        send: Gets the pushes.
    """

    def __init__(self, send: Send) -> None:
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
        imgui.SetNextItemWidth(ITEM_WIDTH)
        self._body = imgui.Combo('body', min(self._body, len(bodies) - 1), bodies)[1]
        for axis, name in enumerate('xyz'):
            imgui.SetNextItemWidth(ITEM_WIDTH)
            value = float(self._force[axis])
            self._force[axis] = imgui.SliderFloat(f'{name} (N)', value, -limit, limit)[1]
        length = float(np.linalg.norm(self._force))
        imgui.Button(f'Push with {min(length, limit):.1f} N while held')
        if imgui.IsItemActive() and length > 0.0:
            wrench = np.concatenate([self._force, np.zeros(3)])
            self._send(Push(bodies[self._body], wrench))
