"""Which of several future goals is worth replaying: any, the most surprising, the least certain."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from policy_node.training.experience.transitions import Transitions

# Future goals that one is chosen of.
CANDIDATES = 8


class Judge(Protocol):
    """What a learner thinks of transitions while a batch is drawn."""

    def act(self, observation: Array32, goal: Array32) -> Array32:
        """Actions (batch, action_size) of the actor."""
        ...

    def surprise(self, batch: Transitions) -> NDArray[np.float32]:
        """Absolute error of each value against its target, (batch,)."""
        ...

    def disagreement(self, batch: Transitions) -> NDArray[np.float32]:
        """Standard deviation over the critics of each value, (batch,)."""
        ...


Score = Callable[[Judge, Transitions], NDArray[np.float32]]

GOAL_CHOICES: dict[str, Score] = {
    'bellman': lambda judge, batch: judge.surprise(batch),
    'uncertain': lambda judge, batch: judge.disagreement(batch),
}
"""What is greatest of the goal to choose; `uniform` takes any."""
