"""What one update learns from, and where in the replay it begins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from policy_node.training.experience.replay import Episodes


@dataclass(frozen=True, slots=True)
class Starts:
    """Where the transitions of a batch begin.

    Attributes:
        episodes: What they are drawn from.
        row: Episode of each, (batch,).
        tick: State that each leads from, (batch,).
        valid_ticks: Ticks of each episode, from its first, that transitions and achieved goals are
            drawn from, (episodes,); None is all.
    """

    episodes: Episodes
    row: NDArray[np.int64]
    tick: NDArray[np.int64]
    valid_ticks: NDArray[np.int64] | None = None

    @property
    def last(self) -> NDArray[np.int64]:
        """Last state of each episode that counts, (batch,)."""
        if self.valid_ticks is None:
            return np.full(len(self.row), self.episodes.ticks)
        return self.valid_ticks.take(self.row)

    def select(self, chosen: NDArray[np.intp]) -> Starts:
        """The transitions at these indices."""
        return Starts(self.episodes, self.row[chosen], self.tick[chosen], self.valid_ticks)


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch for one update, float32; the target of a value is reward + discount * next value.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size); several steps later where returns are longer.
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`.
        discount: (batch,) of the value of the next state.
    """

    observation: Array32
    next_observation: Array32
    goal: Array32
    action: Array32
    reward: Array32
    discount: Array32
