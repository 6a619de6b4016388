"""Gymnasium-Robotics' `GoalEnv`, brought in without letting its own environments take over."""

from __future__ import annotations

import contextlib
import functools
import io
from typing import Any

import gymnasium


@functools.cache
def import_goal_env() -> Any:
    """Imports `gymnasium_robotics.core.GoalEnv`; its ids do not replace those of this package.

    Importing the package registers its environments and prints a remark about other ones. Where it
    is not installed this is `gymnasium.Env`.
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


def _is_ours(spec: gymnasium.envs.registration.EnvSpec) -> bool:
    return isinstance(spec.entry_point, str) and spec.entry_point.startswith('fetch_hand_sim.')
