"""Pictures of a simulation and its goal, through `mujoco.Renderer`."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.simulation import Simulation
from msgs_spec.tasks import GoalKind

_HEIGHT, _WIDTH = 480, 640
_GOAL_COLOR = np.array([0.9, 0.2, 0.2, 0.6], dtype=np.float32)
# Radius of a goal's marker, metres.
_POINT_RADIUS = {'fetch': 0.02, 'shadow_hand': 0.006}
# Camera: the point looked at (m), distance (m), azimuth and elevation (degrees).
_VIEWS = {
    'fetch': ((1.3, 0.75, 0.55), 1.8, 132.0, -20.0),
    'shadow_hand': ((1.0, 0.93, 0.18), 0.5, 55.0, -35.0),
}


class SceneRenderer:
    """Draws the first copy of a simulation: spheres for points, a ghost object for poses."""

    def __init__(self, simulation: Simulation) -> None:
        """Opens an OpenGL context.

        Raises:
            RuntimeError: If there is none.
        """
        self._simulation = simulation
        try:
            self._renderer = mujoco.Renderer(simulation.model, _HEIGHT, _WIDTH)
        except Exception as error:
            raise RuntimeError(
                'rendering needs OpenGL; without a display set MUJOCO_GL=egl or MUJOCO_GL=osmesa '
                f'before Python starts ({error})'
            ) from error
        # The model's own goal markers are sites that nobody moves.
        self._options = mujoco.MjvOption()
        self._options.sitegroup[:] = 0
        self._camera = mujoco.MjvCamera()
        view = _VIEWS[simulation.spec.robot.name]
        self._camera.lookat[:] = view[0]
        self._camera.distance, self._camera.azimuth, self._camera.elevation = view[1:]

    def render(self) -> NDArray[np.uint8]:
        """Returns the picture, (480, 640, 3)."""
        data = self._simulation.data(0)
        goal = self._simulation.observe()['desired_goal'][0]
        if self._simulation.spec.goal is GoalKind.POSE:
            data.joint('target:joint').qpos = goal
        mujoco.mj_forward(self._simulation.model, data)
        self._renderer.update_scene(data, self._camera, self._options)
        if self._simulation.spec.goal is not GoalKind.POSE:
            for point in goal.reshape(-1, 3):
                self._add_sphere(point)
        return np.asarray(self._renderer.render())

    def close(self) -> None:
        """Frees the OpenGL context."""
        self._renderer.close()

    def _add_sphere(self, position: NDArray[np.float64]) -> None:
        scene = self._renderer.scene
        radius = _POINT_RADIUS[self._simulation.spec.robot.name]
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            mujoco.mjtGeom.mjGEOM_SPHERE.value,
            np.array([radius, 0.0, 0.0]),
            position,
            np.eye(3).flatten(),
            _GOAL_COLOR,
        )
        scene.ngeom += 1
