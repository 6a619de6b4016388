"""Policies that know nothing: what success costs without learning."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray


class RestingPolicy:
    """Always the zero action: the gripper stays, the hand takes the middle of its ranges."""

    def __init__(self, action_size: int) -> None:
        self._action_size = action_size

    def predict(
        self, observation: Mapping[str, ArrayLike], *, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Returns zero actions (N, action_size)."""
        del deterministic
        count = len(np.asarray(observation['observation']))
        return np.zeros((count, self._action_size), np.float32), None


class RandomPolicy:
    """Uniformly random actions from a seeded generator."""

    def __init__(self, action_size: int, seed: int = 0) -> None:
        self._action_size = action_size
        self._generator = np.random.default_rng(seed)

    def predict(
        self, observation: Mapping[str, ArrayLike], *, deterministic: bool = True
    ) -> tuple[NDArray[np.float32], None]:
        """Returns actions (N, action_size) in [-1, 1]."""
        del deterministic
        shape = (len(np.asarray(observation['observation'])), self._action_size)
        return self._generator.uniform(-1.0, 1.0, shape).astype(np.float32), None
