"""Parts of the installed Gymnasium-Robotics and of Gymnasium's renderer, made to work here."""

from __future__ import annotations

import contextlib
import functools
import io
import os
from collections.abc import Mapping, Sequence
from functools import partial
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from fetch_hand_sim.simulation.models import find
from fetch_hand_sim.simulation.opengl import prepare_opengl
from msgs_spec.arrays import Array


def _is_ours(spec: gymnasium.envs.registration.EnvSpec) -> bool:
    return isinstance(spec.entry_point, str) and spec.entry_point.startswith('fetch_hand_sim.')


@functools.cache
def import_goal_env() -> Any:
    """Return `GoalEnv` of Gymnasium-Robotics, or `gymnasium.Env` if that is not installed.

    Importing Gymnasium-Robotics registers its environments and prints a note. This function keeps
    the ids of this package and suppresses the note.
    """
    ours = {name: spec for name, spec in gymnasium.registry.items() if _is_ours(spec)}
    for name in ours:
        del gymnasium.registry[name]
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            from gymnasium_robotics.core import GoalEnv
    except ImportError:
        return gymnasium.Env
    finally:
        gymnasium.registry.update(ours)
    return GoalEnv


def mujoco_utils() -> Any:
    """Return `gymnasium_robotics.utils.mujoco_utils` with corrected joint functions.

    The original functions fail with MuJoCo 3.12 and later, where `model.jnt_type[i] ==
    mjtJoint.mjJNT_HINGE` is False for every hinge joint. For hinge or slide, ball and free joints,
    `get_joint_qpos` returns (1,), (4,) and (7,) values, and `get_joint_qvel` (1,), (3,) and (6,).
    `set_joint_qpos` and `set_joint_qvel` take values of these shapes.
    """
    from gymnasium_robotics.utils import mujoco_utils as reference

    working: dict[str, Any] = {'robot_get_obs': robot_get_obs}
    for kind in ('qpos', 'qvel'):
        working[f'get_joint_{kind}'] = partial(_get_joint, kind)
        working[f'set_joint_{kind}'] = partial(_set_joint, kind)
    return SimpleNamespace(**vars(reference) | working)


def _get_joint(kind: str, model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Array:
    return np.array(_joint_values(model, data, name, kind))


def _set_joint(
    kind: str, model: mujoco.MjModel, data: mujoco.MjData, name: str, value: ArrayLike
) -> None:
    _joint_values(model, data, name, kind)[:] = value


def robot_get_obs(
    model: mujoco.MjModel, data: mujoco.MjData, joint_names: Sequence[str]
) -> tuple[Array, Array]:
    """Return positions and velocities, (n,) each, of the n joints that begin with `robot`."""
    names = [name for name in joint_names if name.startswith('robot')]
    qpos, qvel = (
        np.squeeze(np.array([_get_joint(kind, model, data, name) for name in names]))
        for kind in ('qpos', 'qvel')
    )
    return qpos, qvel


def mujoco_renderer(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: Mapping[str, Any],
    width: int,
    height: int,
) -> Any:
    """Return Gymnasium's `MujocoRenderer`, changed to work without a display."""
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

    class Renderer(MujocoRenderer):
        def _get_viewer(self, render_mode: str | None) -> Any:
            if render_mode == 'human':
                return super()._get_viewer(render_mode)
            # The only choice of a backend that Gymnasium reads.
            before = os.environ.get('MUJOCO_GL')
            os.environ['MUJOCO_GL'] = prepare_opengl()
            try:
                viewer = super()._get_viewer(render_mode)
            finally:
                del os.environ['MUJOCO_GL']
                os.environ.update({} if before is None else {'MUJOCO_GL': before})
            # Another environment may have drawn in between.
            viewer.make_context_current()
            return viewer

    size = model.vis.global_
    size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
    return Renderer(model, data, dict(camera), width=width, height=height)


def depth_in_metres(model: mujoco.MjModel, depth: Any) -> Any:
    """Convert an OpenGL depth buffer, values in [0, 1], to distances from the camera plane, m."""
    near, far = (plane * model.stat.extent for plane in (model.vis.map.znear, model.vis.map.zfar))
    return (near / (1.0 - depth * (1.0 - near / far))).astype(np.float32)


def _joint_values(model: mujoco.MjModel, data: mujoco.MjData, name: str, kind: str) -> Any:
    """Return a view of a joint's entries in `data`; `kind` is `qpos` or `qvel`."""
    if find(model, mujoco.mjtObj.mjOBJ_JOINT, name) < 0:
        raise ValueError(f'the model has no joint {name!r}')
    return getattr(data.joint(name), kind)
