"""Goals that earlier episodes failed to meet, tried again."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation

# Failures that are remembered; of these each is drawn equally often.
REMEMBERED = 1024


class FailedGoals:
    """Gives a share of the episodes goals of earlier failures, so that hard goals come more often.

    Only episodes with a goal as the task draws it are remembered: so a goal is tried again in
    proportion to how often the actor fails at it, and one that cannot be met does not crowd out the
    others.

    Args:
        generator: Draws episodes and goals.
        share: Share of the episodes, 0 ... 1.
    """

    def __init__(self, generator: np.random.Generator, share: float) -> None:
        self._generator = generator
        self._share = share
        self._failed: list[NDArray[np.float64]] = []

    def give(self, simulation: Simulation) -> NDArray[np.bool_]:
        """Replaces goals of simulations that were just reset.

        Returns:
            (num_envs,) which have a goal of an earlier failure.
        """
        count = simulation.num_envs
        given = np.zeros(count, dtype=np.bool_)
        if not self._failed:
            return given
        given[:] = self._generator.random(count) < self._share
        chosen = self._generator.integers(len(self._failed), size=int(given.sum()))
        # As they were: `set_goal` would turn the quaternions of long ways to the nearer sign.
        simulation.goals[given] = np.array(self._failed)[chosen]
        return given

    def remember(self, simulation: Simulation, failed: NDArray[np.bool_]) -> None:
        """Remembers the goals of simulations whose episodes `failed`; the oldest are forgotten."""
        self._failed.extend(simulation.goals[failed].copy())
        del self._failed[:-REMEMBERED]
