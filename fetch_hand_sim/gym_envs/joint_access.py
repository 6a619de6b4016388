"""Joint access of `gymnasium_robotics.utils.mujoco_utils`, which fails with MuJoCo 3.12 and later.

There `model.jnt_type[i] == mjtJoint.mjJNT_HINGE` is False for every hinge and slide joint.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from msgs_spec.arrays import Array


def get_joint_qpos(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Array:
    """Return the position of a joint: (1,) rad or m, (4,) of a ball, (7,) of a free joint."""
    return np.array(_values(model, data, name, 'qpos'))


def get_joint_qvel(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> Array:
    """Return the velocity of a joint: (1,) rad/s or m/s, (3,) of a ball, (6,) of a free joint."""
    return np.array(_values(model, data, name, 'qvel'))


def set_joint_qpos(model: mujoco.MjModel, data: mujoco.MjData, name: str, value: ArrayLike) -> None:
    """Set the position of a joint, in the form that `get_joint_qpos` returns."""
    _values(model, data, name, 'qpos')[:] = value


def set_joint_qvel(model: mujoco.MjModel, data: mujoco.MjData, name: str, value: ArrayLike) -> None:
    """Set the velocity of a joint, in the form that `get_joint_qvel` returns."""
    _values(model, data, name, 'qvel')[:] = value


def robot_get_obs(
    model: mujoco.MjModel, data: mujoco.MjData, joint_names: Sequence[str]
) -> tuple[Array, Array]:
    """Return positions and velocities of the joints whose names begin with `robot`."""
    names = [name for name in joint_names if name.startswith('robot')]
    qpos = [get_joint_qpos(model, data, name) for name in names]
    qvel = [get_joint_qvel(model, data, name) for name in names]
    return np.squeeze(np.array(qpos)), np.squeeze(np.array(qvel))


def _values(model: mujoco.MjModel, data: mujoco.MjData, name: str, kind: str) -> Any:
    """Return the entries of `qpos` or `qvel` that belong to a joint, live."""
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT.value, name) < 0:
        raise ValueError(f'the model has no joint {name!r}')
    return getattr(data.joint(name), kind)
