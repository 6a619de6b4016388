"""Parts of the installed Gymnasium-Robotics and of Gymnasium's renderer, made to work here."""

from __future__ import annotations

import contextlib
import functools
import io
import os
from collections.abc import Iterator, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import ArrayLike

from fetch_hand_sim.simulation.opengl import prepare_opengl
from msgs_spec.arrays import Array


@functools.cache
def import_goal_env() -> Any:
    """Return `gymnasium_robotics.core.GoalEnv`, or `gymnasium.Env` if it is not installed.

    Importing Gymnasium-Robotics registers its environments and prints a remark. Ids of this package
    stay as they are, and the remark is dropped.
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
    """Return the names of `gymnasium_robotics.utils.mujoco_utils` with working joint functions.

    Its own fail with MuJoCo 3.12 and later, where `model.jnt_type[i] == mjtJoint.mjJNT_HINGE` is
    False for every hinge and slide joint.
    """
    from gymnasium_robotics.utils import mujoco_utils as reference

    working = (get_joint_qpos, get_joint_qvel, set_joint_qpos, set_joint_qvel, robot_get_obs)
    return SimpleNamespace(**vars(reference) | {each.__name__: each for each in working})


def get_joint_qpos(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Array:
    """Return the position of a joint: (1,) rad or m, (4,) of a ball, (7,) of a free joint."""
    return np.array(_joint_values(model, data, name, 'qpos'))


def get_joint_qvel(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Array:
    """Return the velocity of a joint: (1,) rad/s or m/s, (3,) of a ball, (6,) of a free joint."""
    return np.array(_joint_values(model, data, name, 'qvel'))


def set_joint_qpos(model: mujoco.MjModel, data: mujoco.MjData, name: str, value: ArrayLike) -> None:
    """Set the position of a joint, in the form that `get_joint_qpos` returns."""
    _joint_values(model, data, name, 'qpos')[:] = value


def set_joint_qvel(model: mujoco.MjModel, data: mujoco.MjData, name: str, value: ArrayLike) -> None:
    """Set the velocity of a joint, in the form that `get_joint_qvel` returns."""
    _joint_values(model, data, name, 'qvel')[:] = value


def robot_get_obs(
    model: mujoco.MjModel, data: mujoco.MjData, joint_names: Sequence[str]
) -> tuple[Array, Array]:
    """Return positions and velocities of the joints whose names begin with `robot`."""
    names = [name for name in joint_names if name.startswith('robot')]
    qpos = [get_joint_qpos(model, data, name) for name in names]
    qvel = [get_joint_qvel(model, data, name) for name in names]
    return np.squeeze(np.array(qpos)), np.squeeze(np.array(qvel))


def mujoco_renderer(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    camera: Mapping[str, Any],
    width: int,
    height: int,
) -> Any:
    """Return Gymnasium's `MujocoRenderer`, which also draws without a display."""
    from gymnasium.envs.mujoco.mujoco_rendering import MujocoRenderer

    class Renderer(MujocoRenderer):
        def _get_viewer(self, render_mode: str | None) -> Any:
            if render_mode == 'human':
                return super()._get_viewer(render_mode)
            with _opengl_backend(prepare_opengl()):
                viewer = super()._get_viewer(render_mode)
            # Another environment may have drawn in between.
            viewer.make_context_current()
            return viewer

    size = model.vis.global_
    size.offwidth, size.offheight = max(size.offwidth, width), max(size.offheight, height)
    return Renderer(model, data, dict(camera), width=width, height=height)


def depth_in_metres(model: mujoco.MjModel, depth: Any) -> Any:
    """Return distances from the camera plane, m, of an OpenGL depth buffer in [0, 1]."""
    near, far = (plane * model.stat.extent for plane in (model.vis.map.znear, model.vis.map.zfar))
    return (near / (1.0 - depth * (1.0 - near / far))).astype(np.float32)


@contextlib.contextmanager
def _opengl_backend(backend: str) -> Iterator[None]:
    """Set `MUJOCO_GL`, the only choice of a backend that Gymnasium reads."""
    before = os.environ.get('MUJOCO_GL')
    os.environ['MUJOCO_GL'] = backend
    try:
        yield
    finally:
        if before is None:
            del os.environ['MUJOCO_GL']
        else:
            os.environ['MUJOCO_GL'] = before


def _is_ours(spec: gymnasium.envs.registration.EnvSpec) -> bool:
    return isinstance(spec.entry_point, str) and spec.entry_point.startswith('fetch_hand_sim.')


def _joint_values(model: mujoco.MjModel, data: mujoco.MjData, name: str, kind: str) -> Any:
    """Return the entries of `qpos` or `qvel` that belong to a joint, live."""
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT.value, name) < 0:
        raise ValueError(f'the model has no joint {name!r}')
    return getattr(data.joint(name), kind)
