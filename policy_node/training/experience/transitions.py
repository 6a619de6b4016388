"""Batches of transitions, and the states in the replay where they begin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from policy_node.training.experience.replay import Episodes


@dataclass(frozen=True, slots=True)
class Starts:
    """The states in which the transitions of a batch begin.

    Attributes:
        episodes: The episodes.
        row: Episode of each transition, (batch,).
        tick: Tick of its first state, (batch,).
        valid_ticks: Number of ticks of each episode that count, from its first, (episodes,); None
            is all.
    """

    episodes: Episodes
    row: NDArray[np.int64]
    tick: NDArray[np.int64]
    valid_ticks: NDArray[np.int64] | None = None

    @property
    def last(self) -> NDArray[np.int64]:
        """Last valid state of each episode, (batch,)."""
        if self.valid_ticks is None:
            return np.full(len(self.row), self.episodes.ticks)
        return self.valid_ticks.take(self.row)

    def select(self, chosen: NDArray[np.intp]) -> Starts:
        """Return the transitions at these indices."""
        return Starts(self.episodes, self.row[chosen], self.tick[chosen], self.valid_ticks)


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch for one update, float32. A target is reward + discount * next value.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size), at the end of the return.
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`.
        discount: (batch,) factor on the value of the next state.
    """

    observation: Array32
    next_observation: Array32
    goal: Array32
    action: Array32
    reward: Array32
    discount: Array32
