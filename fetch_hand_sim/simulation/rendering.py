"""Render pictures of a scene with `mujoco.Renderer`."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NoReturn

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.arguments import require_whole
from fetch_hand_sim.simulation.opengl import ADVICE, context_of_its_own, prepare_opengl
from fetch_hand_sim.simulation.scene import SHOWN_SITES, Frame, Scene
from fetch_hand_sim.simulation.simulation import Simulation
from msgs_spec.arrays import Array, Picture
from msgs_spec.parameters import LARGEST_PICTURE_SIDE
from msgs_spec.text import entries, one_line, one_of

WIDTH, HEIGHT = 640, 480


class SceneRenderer:
    """Renders frames of a scene without a display.

    With EGL any thread may render and close, one at a time. With other backends only the thread
    that created the renderer may.

    Args:
        width: Pixels, 1 ... `LARGEST_PICTURE_SIDE`.
        height: Pixels, 1 ... `LARGEST_PICTURE_SIDE`.
        camera: Name of a camera of the model, or attributes of `mujoco.MjvCamera` that change the
            scene's view; None for the unchanged view.

    Raises:
        ValueError: If the camera is unknown or the size is not allowed.
        RuntimeError: If OpenGL is missing.
    """

    def __init__(
        self,
        scene: Scene,
        width: int = WIDTH,
        height: int = HEIGHT,
        camera: str | Mapping[str, Any] | None = None,
    ) -> None:
        # OpenGL's errors would be misleading.
        check_size(width, height)
        self._scene = scene
        self._camera = make_camera(scene, camera)
        self._options = make_options()
        scene.model.vis.global_.offwidth = max(width, int(scene.model.vis.global_.offwidth))
        scene.model.vis.global_.offheight = max(height, int(scene.model.vis.global_.offheight))
        prepare_opengl()
        self._thread = threading.get_ident()
        try:
            with context_of_its_own():
                self._renderer = mujoco.Renderer(scene.model, height, width)
        except Exception as error:
            raise RuntimeError(f'{ADVICE} ({error})') from error

    def render(self, frame: Frame, trail: Sequence[Array] = ()) -> Picture:
        """Return the picture of a frame, (height, width, 3) bytes.

        Args:
            trail: Earlier positions of object, gripper or first fingertip, (3,) each, m.
        """
        self._update(frame)
        scene = self._renderer.scene
        for marker in self._scene.markers(frame, trail):
            marker.draw(scene.geoms[scene.ngeom])
            scene.ngeom += 1
        with self._in_its_thread():
            return np.asarray(self._renderer.render())

    def render_depth(self, frame: Frame) -> NDArray[np.float32]:
        """Return distances from the camera plane, (height, width), m; goal markers are left out."""
        self._update(frame)
        self._renderer.enable_depth_rendering()
        try:
            with self._in_its_thread():
                return np.asarray(self._renderer.render())
        finally:
            self._renderer.disable_depth_rendering()

    def close(self) -> None:
        """Free the OpenGL context; raise RuntimeError if it belongs to another thread."""
        with self._in_its_thread():
            self._renderer.close()

    @contextlib.contextmanager
    def _in_its_thread(self) -> Iterator[None]:
        """Replace an error in the block by a RuntimeError if another thread made the renderer."""
        try:
            with context_of_its_own():
                yield
        except Exception as error:
            if threading.get_ident() == self._thread:
                raise
            raise RuntimeError(
                'OpenGL works in one thread only: render and close in the thread that created the '
                f'renderer ({type(error).__name__})'
            ) from error

    def _update(self, frame: Frame) -> None:
        # A forked process may have inherited this renderer.
        prepare_opengl()
        self._scene.show(frame)
        mujoco.mj_forward(self._scene.model, self._scene.data)
        self._renderer.update_scene(self._scene.data, self._camera, self._options)


def make_options() -> mujoco.MjvOption:
    """Return drawing options that hide rangefinder rays and sites outside group `SHOWN_SITES`."""
    options = mujoco.MjvOption()
    options.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER.value] = 0
    options.sitegroup[:] = 0
    options.sitegroup[SHOWN_SITES] = 1
    return options


def check_size(width: object, height: object) -> None:
    """Raise ValueError unless both sides of a picture are 1 ... `LARGEST_PICTURE_SIDE` pixels."""
    for name, side in (('width', width), ('height', height)):
        require_whole(name, side, 1, LARGEST_PICTURE_SIDE)


def make_camera(scene: Scene, name: str | Mapping[str, Any] | None) -> mujoco.MjvCamera:
    """Return the camera called `name`; None gives the default view of the scene.

    A mapping gives the default view with these attributes of `MjvCamera` set. Unknown names and
    invalid values raise ValueError.
    """
    camera = mujoco.MjvCamera()
    if name is None or isinstance(name, Mapping):
        scene.view.apply(camera)
        set_attributes(camera, name or {}, scene.model)
        return camera
    names = [scene.model.camera(index).name for index in range(scene.model.ncam)]
    camera.type = mujoco.mjtCamera.mjCAMERA_FIXED.value
    camera.fixedcamid = names.index(one_of(name, names, 'camera'))
    return camera


def set_attributes(
    camera: mujoco.MjvCamera, attributes: Mapping[str, Any], model: mujoco.MjModel
) -> None:
    """Set attributes of `camera`, such as `distance`, for pictures of `model`.

    Raises:
        ValueError: If an attribute is unknown, or if MuJoCo cannot render with its value.
    """
    known = [name for name in dir(mujoco.MjvCamera) if not name.startswith('_')]
    for name, value in entries('default_camera_config', attributes, known).items():
        before = getattr(camera, name)
        try:
            if np.ndim(value):
                before[:] = value
            else:
                setattr(camera, name, value)
        except (TypeError, ValueError):
            _refuse(name, value, f'as {before!r}')
        if not np.isfinite(getattr(camera, name)).all():
            _refuse(name, value, 'finite numbers')
    kinds = mujoco.mjtCamera
    fixed, tracking = kinds.mjCAMERA_FIXED.value, kinds.mjCAMERA_TRACKING.value
    if camera.type not in (kinds.mjCAMERA_FREE.value, fixed, tracking):
        _refuse('type', camera.type, '0 (free), 1 (tracking), 2 (fixed)')
    if camera.type == fixed and not 0 <= camera.fixedcamid < model.ncam:
        _refuse('fixedcamid', camera.fixedcamid, f'0 ... {model.ncam - 1}')
    if camera.type == tracking and not 0 <= camera.trackbodyid < model.nbody:
        _refuse('trackbodyid', camera.trackbodyid, f'0 ... {model.nbody - 1}')


def _refuse(name: str, value: object, allowed: str) -> NoReturn:
    raise ValueError(f'default_camera_config: {name} {one_line(value, 40)!r}; allowed: {allowed}')


def simulation_frame(simulation: Simulation, index: int = 0) -> Frame:
    """Return the true state of simulation `index` of a batch as a `Frame`, for pictures."""
    readings, observation = simulation.true_readings(), simulation.observe()
    achieved, desired = observation['achieved_goal'][index], observation['desired_goal'][index]
    spec = simulation.spec
    return Frame(
        joint_position=readings['joint_states'][index, : len(spec.robot.joints)],
        desired_goal=desired,
        achieved_goal=achieved,
        object_pose=readings['object_pose'][index] if spec.has_object else None,
        is_success=bool(simulation.compute_success(achieved, desired)),
        qpos=simulation.task.batch.bind('qpos')[index].copy(),
    )
