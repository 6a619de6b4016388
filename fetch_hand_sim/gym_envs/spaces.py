"""Gymnasium's description of a task's observations and actions."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from msgs_spec.tasks import TaskSpec


def observation_space(spec: TaskSpec) -> spaces.Space[Any]:
    """`observation`, `achieved_goal` and `desired_goal`, float64, unbounded, SI units."""
    return spaces.Dict(
        {
            'observation': _unbounded(spec.observation_size),
            'achieved_goal': _unbounded(spec.goal.size),
            'desired_goal': _unbounded(spec.goal.size),
        }
    )


def action_space(spec: TaskSpec) -> spaces.Space[Any]:
    """The normalised action in [-1, 1], float32."""
    return spaces.Box(-1.0, 1.0, shape=(spec.robot.action_size,), dtype=np.float32)


def clip_actions(actions: NDArray[Any]) -> NDArray[Any]:
    """Actions in [-1, 1], as Gymnasium-Robotics takes them; what is no number stays, refused later.

    The type stays too: the Fetch tasks scale actions in it.
    """
    return np.clip(actions, -1.0, 1.0) if actions.dtype.kind in 'fiu' else actions


def _unbounded(size: int) -> spaces.Box:
    return spaces.Box(-np.inf, np.inf, shape=(size,), dtype=np.float64)
