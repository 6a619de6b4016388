"""Pull a body by a spring between mouse and body, which MuJoCo calls a perturbation."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco.studio import messages, ux, viewer_protocol

from fetch_hand_sim.simulation.scene import GHOST
from fetch_hand_sim.view.page.ray import Ray
from msgs_spec.arrays import Array

_FORCES = mujoco.mjtState.mjSTATE_XFRC_APPLIED.value
_TRANSLATE = mujoco.mjtPertBit.mjPERT_TRANSLATE.value
_IN_THE_PICTURE = mujoco.mjtMouse.mjMOUSE_MOVE_V.value
# Length of a pull with the largest force, as a share of the camera's distance.
_REACH = 0.1


def can_be_pulled(model: mujoco.MjModel, body: int) -> bool:
    """Return whether a body can move, has a name, and is not the ghost that shows a goal."""
    if body <= 0 or model.body(body).name in ('', GHOST):
        return False
    while body:
        if model.body_dofnum[body]:
            return True
        body = model.body_parentid[body]
    return False


def pulls(model: mujoco.MjModel, snapshot: messages.PerturbSnapshot) -> list[tuple[str, Array]]:
    """Return the name of each body that a snapshot pulls and its wrench (6,), N and N m.

    Wrenches act at the centre of mass, along the world axes. A snapshot whose size does not fit
    `model` gives [].
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
    """A spring between the mouse and a body; the viewer draws it as a perturbation of MuJoCo."""

    def __init__(self, viewer: viewer_protocol.Viewer) -> None:
        self._viewer = viewer

    @property
    def is_pulling(self) -> bool:
        """True while the mouse holds a body."""
        return bool(self._viewer.perturb.active)

    def begin(self, ray: Ray, limit: float) -> bool:
        """Grab the body under the mouse; return False if no body there can be pulled.

        The force reaches `limit`, N, at a spring length of 0.1 times the distance of the camera.
        """
        viewer, perturb = self._viewer, self._viewer.perturb
        model, data = viewer.model, viewer.data
        body, point = _body_under(model, data, viewer.vis_options, ray)
        if not can_be_pulled(model, body):
            return False
        perturb.select, perturb.flexselect, perturb.skinselect = body, -1, -1
        perturb.localpos = data.xmat[body].reshape(3, 3).T @ (point - data.xpos[body])
        ux.InitPerturb(model, data, viewer.camera, perturb, _TRANSLATE)
        perturb.active = _TRANSLATE
        # The force reaches the limit at the same length for every mass.
        reach = _REACH * viewer.camera.distance
        perturb.localmass = limit / (model.vis.map.stiffness * reach)
        return True

    def move(self, delta: Sequence[float]) -> messages.PerturbSnapshot:
        """Move the spring's end with the mouse; return the wrenches on all bodies as a message.

        `delta` (2,) is the movement of the mouse since the last call, to the right in widths and
        down in heights of the picture.
        """
        viewer, data = self._viewer, self._viewer.data
        if any(delta):
            ux.MovePerturb(
                viewer.model, data, viewer.camera, viewer.perturb, _IN_THE_PICTURE, *delta
            )
        data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(viewer.model, data, viewer.perturb)
        return messages.PerturbSnapshot(data.xfrc_applied.ravel().copy(), _FORCES)

    def end(self) -> None:
        """Release the body and remove the force on it."""
        self._viewer.perturb.active = self._viewer.perturb.select = 0
        self._viewer.data.xfrc_applied[:] = 0.0


def _body_under(
    model: mujoco.MjModel, data: mujoco.MjData, options: mujoco.MjvOption, ray: Ray
) -> tuple[int, Array]:
    """Return the first body that a ray hits (-1 if none; not the ghost), and the point (3,), m."""
    ghost = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY.value, GHOST)
    geom = np.full((1, 1), -1, dtype=np.int32)
    distance = mujoco.mj_ray(
        model, data, ray.origin, ray.direction, options.geomgroup, 1, ghost, geom, None
    )
    body = int(model.geom_bodyid[geom[0, 0]]) if distance >= 0.0 else -1
    return body, ray.origin + distance * ray.direction
