"""A camera with a rate of its own."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.scene import Frame, Scene
from msgs_spec.arrays import Picture
from node_runtime.diagnostics import Durations


class Camera:
    """Pictures of one scene.

    Args:
        width: Pixels.
        height: Pixels.
        hz: Largest number of pictures per second of the clock; 0 for none.
        clock: A steady clock, seconds.
    """

    def __init__(self, width: int, height: int, hz: float, clock: Callable[[], float]) -> None:
        self.width, self.height = width, height
        self.pictures = 0
        self.picture_time = Durations()
        self._hz = hz
        self._period = 1.0 / hz if hz else np.inf
        self._clock = clock
        self._due = clock()
        self._renderer: SceneRenderer | None = None

    @property
    def is_due(self) -> bool:
        """True if it is time for the next picture."""
        return np.isfinite(self._period) and self._clock() >= self._due

    def render(self, scene: Scene, frame: Frame) -> Picture:
        """Return a picture (height, width, 3); the first call opens OpenGL."""
        began = self._clock()
        self._due = max(self._due + self._period, began)
        if self._renderer is None:
            self._renderer = SceneRenderer(scene, self.width, self.height)
        picture = self._renderer.render(frame)
        self.pictures += 1
        self.picture_time.add(self._clock() - began)
        return picture

    def problem(self) -> str:
        """Return why pictures are fewer than requested, or ''."""
        seconds = self.picture_time.median()
        if seconds <= self._period:
            return ''
        return (
            f'a picture takes {seconds:.2g} s, so that {1.0 / seconds:.2g} of the {self._hz:g} '
            'pictures per second are possible; reduce camera_width and camera_height, or use a GPU'
        )

    def close(self) -> None:
        """Free OpenGL; another scene may follow."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None
