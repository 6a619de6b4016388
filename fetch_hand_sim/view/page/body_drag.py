"""Pulling at a body with the mouse: MuJoCo's perturbation, as a spring between body and mouse."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.studio import messages, ux

from fetch_hand_sim.simulation.scene import GHOST
from fetch_hand_sim.view.page.ray import Ray
from msgs_spec.arrays import Array

_FORCES = mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
_TRANSLATE = mujoco.mjtPertBit.mjPERT_TRANSLATE.value
_IN_THE_PICTURE = mujoco.mjtMouse.mjMOUSE_MOVE_V.value
# Pulling this far, a share of the distance to what is looked at, pulls as hard as is allowed.
_REACH = 0.1


def can_be_pulled(model: mujoco.MjModel, body: int) -> bool:
    """Whether a body moves when it is pulled: it has a name, and is neither world nor ghost."""
    if body <= 0 or model.body(body).name in ('', GHOST):
        return False
    while body:
        if model.body_dofnum[body]:
            return True
        body = model.body_parentid[body]
    return False


def pulls(model: mujoco.MjModel, snapshot: messages.PerturbSnapshot) -> list[tuple[str, Array]]:
    """Returns the bodies that a viewer pulls at, with their wrenches (6,) in N and N m.

    Forces and torques are along the axes of the world, at the centre of mass; a snapshot of another
    model holds none.
    """
    size = mujoco.mj_stateSize(model, _FORCES)
    if snapshot.state_sig != _FORCES or snapshot.state.shape != (size,):
        return []
    wrenches = snapshot.state.reshape(model.nbody, 6)
    pulled = np.flatnonzero(np.isfinite(wrenches).all(axis=1) & wrenches.any(axis=1))
    return [
        (model.body(body).name, wrenches[body].copy())
        for body in pulled.tolist()
        if can_be_pulled(model, body)
    ]


class BodyDrag:
    """A spring between the mouse and the body at which it was pressed.

    Args:
        perturb: The perturbation that a viewer draws.
    """

    def __init__(self, perturb: mujoco.MjvPerturb) -> None:
        self._perturb = perturb

    @property
    def is_pulling(self) -> bool:
        """Whether the mouse holds a body."""
        return bool(self._perturb.active)

    def begin(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera,
        options: mujoco.MjvOption,
        ray: Ray,
        limit: float,
    ) -> bool:
        """Takes the body under the mouse; False if there is none that could move.

        Args:
            model: What is shown.
            data: Its state.
            camera: From where.
            options: What of it is drawn.
            ray: Under the mouse.
            limit: Largest force, N.
        """
        body, point = _body_under(model, data, options, ray)
        if not can_be_pulled(model, body):
            return False
        perturb = self._perturb
        perturb.select, perturb.flexselect, perturb.skinselect = body, -1, -1
        perturb.localpos = data.xmat[body].reshape(3, 3).T @ (point - data.xpos[body])
        ux.InitPerturb(model, data, camera, perturb, _TRANSLATE)
        perturb.active = _TRANSLATE
        # A spring that reaches the limit where people expect it, whatever the body weighs.
        perturb.localmass = limit / (model.vis.map.stiffness * _REACH * camera.distance)
        return True

    def move(
        self,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        camera: mujoco.MjvCamera,
        delta: Sequence[float],
    ) -> messages.PerturbSnapshot:
        """Follows the mouse; returns what pulls now.

        Args:
            model: What is shown.
            data: Its state; gets the force, so that it is drawn.
            camera: From where.
            delta: (2,) how far the mouse went since the last call, in widths and heights of the
                picture.
        """
        if any(delta):
            ux.MovePerturb(model, data, camera, self._perturb, _IN_THE_PICTURE, *delta)
        data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(model, data, self._perturb)
        return messages.PerturbSnapshot(data.xfrc_applied.ravel().copy(), _FORCES)

    def end(self, data: mujoco.MjData) -> None:
        """Lets go."""
        self._perturb.active = self._perturb.select = 0
        data.xfrc_applied[:] = 0.0


def _body_under(
    model: mujoco.MjModel, data: mujoco.MjData, options: mujoco.MjvOption, ray: Ray
) -> tuple[int, Array]:
    """The first body on a ray and where it is met; a ghost is looked through, -1 for none."""
    ghost = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY.value, GHOST)
    geom = np.full((1, 1), -1, dtype=np.int32)
    distance = mujoco.mj_ray(
        model, data, ray.origin, ray.direction, options.geomgroup, 1, ghost, geom, None
    )
    body = int(model.geom_bodyid[geom[0, 0]]) if distance >= 0.0 else -1
    return body, ray.origin + distance * ray.direction
