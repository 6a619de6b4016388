"""A camera that draws only while somebody looks, at a rate of its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.scene import Frame, Scene
from msgs_spec.arrays import Picture


class Camera:
    """Pictures of one scene.

    Args:
        width: Pixels.
        height: Pixels.
        hz: Pictures per second of the clock, at most; 0 for none.
        clock: A steady clock, seconds.
    """

    def __init__(self, width: int, height: int, hz: float, clock: Callable[[], float]) -> None:
        self.width, self.height = width, height
        self._period = 1.0 / hz if hz else np.inf
        self._clock = clock
        self._due = clock()
        self._renderer: SceneRenderer | None = None

    @property
    def is_due(self) -> bool:
        """Whether it is time for the next picture."""
        return np.isfinite(self._period) and self._clock() >= self._due

    def render(self, scene: Scene, frame: Frame) -> Picture:
        """Returns a picture (height, width, 3); the first one opens OpenGL.

        Raises:
            RuntimeError: If there is no OpenGL.
        """
        self._due = max(self._due + self._period, self._clock())
        if self._renderer is None:
            self._renderer = SceneRenderer(scene, self.width, self.height)
        return self._renderer.render(frame)

    def close(self) -> None:
        """Frees OpenGL; another scene may follow."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
