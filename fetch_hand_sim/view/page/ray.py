"""Compute rays from a free camera through the mouse position into the world."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from fetch_hand_sim.simulation.scene import View
from msgs_spec.arrays import Array


@dataclass(frozen=True, slots=True)
class MousePlace:
    """Position of the mouse in the picture.

    Attributes:
        x: 0 ... 1 from the left.
        y: 0 ... 1 from the top.
        aspect: Width of the picture divided by its height.
    """

    x: float
    y: float
    aspect: float


@dataclass(frozen=True, slots=True)
class Ray:
    """A half line from the camera, and the axes of the camera, in world coordinates.

    Attributes:
        origin: (3,) start of the line, m.
        direction: (3,) unit vector.
        forward: (3,) unit vector, view direction of the camera.
        right: (3,) unit vector to the right of the picture.
        up: (3,) unit vector to the top of the picture.
    """

    origin: Array
    direction: Array
    forward: Array
    right: Array
    up: Array

    def distance_to(self, point: Array) -> float:
        """Return the distance of a point (3,) from the ray, m; infinity behind its start."""
        offset = point - self.origin
        along = float(offset @ self.direction)
        if along <= 0.0:
            return float('inf')
        return float(np.linalg.norm(offset - along * self.direction))

    def meets_plane(self, point: Array, normal: Array) -> Array | None:
        """Return the intersection (3,) with the plane through `point`; None if they do not meet."""
        slope = float(self.direction @ normal)
        if abs(slope) < 1e-6:
            return None
        along = float((point - self.origin) @ normal) / slope
        return self.origin + along * self.direction if along > 0.0 else None


def mouse_ray(camera: View | mujoco.MjvCamera, fovy: float, mouse: MousePlace) -> Ray:
    """Return the ray through the mouse; `fovy` is the vertical field of view, degrees."""
    forward, right, up = camera_axes(camera)
    half = np.tan(np.radians(fovy) / 2.0)
    x, y = (2.0 * mouse.x - 1.0) * half * mouse.aspect, (1.0 - 2.0 * mouse.y) * half
    direction = forward + x * right + y * up
    direction /= np.linalg.norm(direction)
    origin = np.array(camera.lookat) - camera.distance * forward
    return Ray(origin, direction, forward, right, up)


def camera_axes(camera: View | mujoco.MjvCamera) -> tuple[Array, Array, Array]:
    """Return unit vectors (3,) in the world: view direction, right and top of the picture."""
    a, e = np.radians(camera.azimuth), np.radians(camera.elevation)
    forward = np.array([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)])
    right = np.array([np.sin(a), -np.cos(a), 0.0])
    return forward, right, np.cross(right, forward)
