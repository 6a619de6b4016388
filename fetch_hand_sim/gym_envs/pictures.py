"""Draw the pictures that `render` of the environments returns or shows."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.opengl import start_glfw
from fetch_hand_sim.simulation.rendering import (
    SceneRenderer,
    check_size,
    make_camera,
    make_options,
    set_attributes,
    simulation_frame,
)
from fetch_hand_sim.simulation.scene import Frame, Scene

Image = NDArray[np.uint8] | NDArray[np.float32]

# `rgb_array_list` and other lists are made of these by `gymnasium.make`.
RENDER_MODES = ['human', 'rgb_array', 'depth_array']


class Pictures:
    """Renders the robots of a batch; opens OpenGL or a window at the first picture.

    `camera` contains attributes of `mujoco.MjvCamera` by name. The constructor raises ValueError
    for an invalid attribute or size (pixels). `render` raises RuntimeError if OpenGL is missing or,
    in mode `human`, if the display is missing.
    """

    def __init__(
        self,
        simulation: Simulation,
        width: int,
        height: int,
        camera: Mapping[str, Any] | None,
    ) -> None:
        check_size(width, height)
        set_attributes(mujoco.MjvCamera(), {} if camera is None else camera, simulation.model)
        self._simulation = simulation
        self._size = (width, height)
        self._camera = dict(camera or {})
        self._scene: Scene | None = None
        self._renderer: SceneRenderer | None = None
        self._window: Any = None

    def render(self, mode: str, index: int = 0) -> Image | None:
        """Return a picture of robot `index` of the batch, in one of the `RENDER_MODES`.

        `depth_array` returns distances from the camera plane (height, width), m. `human` shows the
        picture in a window and returns None.
        """
        if self._scene is None:
            self._scene = Scene(self._simulation.spec.name)
        # With the thresholds that hold now: goals are drawn as large as they are.
        self._scene.spec = self._simulation.metric.spec
        frame = simulation_frame(self._simulation, index)
        if mode == 'human':
            self._show(self._scene, frame)
            return None
        if self._renderer is None:
            self._renderer = SceneRenderer(self._scene, *self._size, self._camera)
        draw = self._renderer.render_depth if mode == 'depth_array' else self._renderer.render
        return draw(frame)

    def close(self) -> None:
        """Close the OpenGL context and the window."""
        if self._renderer is not None:
            self._renderer.close()
        if self._window is not None:
            self._window.close()
        self._renderer = self._window = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for `pickle` without OpenGL objects; an unpickled copy opens its own."""
        return self.__dict__ | {'_scene': None, '_renderer': None, '_window': None}

    def _show(self, scene: Scene, frame: Frame) -> None:
        """Draw a frame in Gymnasium's window; the first call opens the window."""
        if self._window is None:
            self._window = _open_window(scene, *self._size)
            self._window.cam = make_camera(scene, self._camera)
            self._window.vopt = make_options()
        scene.show(frame)
        mujoco.mj_forward(scene.model, scene.data)
        for marker in scene.markers(frame):
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, marker.quaternion)
            color = np.array(marker.color, dtype=np.float32)
            self._window.add_marker(
                type=marker.shape, size=marker.size, pos=marker.position, mat=rotation, rgba=color
            )
        self._window.render()


def _open_window(scene: Scene, width: int, height: int) -> Any:
    """Return a new window that shows a scene; raise RuntimeError without a display."""
    try:
        from gymnasium.envs.mujoco.mujoco_rendering import WindowViewer

        has_display = start_glfw()
    except ImportError as error:
        raise RuntimeError(
            f"render_mode 'human' needs pip install glfw imageio ({error})"
        ) from error
    if not has_display:
        raise RuntimeError(
            "render_mode 'human' needs a display; without one use render_mode='rgb_array'"
        )
    return WindowViewer(scene.model, scene.data, width, height)
