"""Returns of several steps: how many of them a transition may count before it bootstraps.

A return of n steps carries rewards back n times as fast, but it is that of the actions taken, not
of the actor's. `none` takes that bias. `lambda` draws the number of steps from a geometric
distribution cut at n, so that the mean target is the truncated lambda-return (Sutton and Barto
2018, 12.3); the average of MHER(lambda) (arXiv 2102.12962) weighs the longest return less.
`cut` ends a return before the first action that is far from the actor's for the same goal.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array32
from policy_node.training.experience.transitions import Starts

CORRECTIONS = ('none', 'lambda', 'cut')

Act = Callable[[Array32, Array32], Array32]


@dataclass(frozen=True, slots=True)
class StepCounter:
    """How many steps returns have.

    Attributes:
        most: The most.
        correction: One of `CORRECTIONS`.
        trace: With `lambda`, the probability of going on after each step.
        cut_distance: With `cut`, the farthest action from the actor's, root mean square.
    """

    most: int
    correction: str = 'none'
    trace: float = 0.7
    cut_distance: float = 0.3

    def count(
        self, starts: Starts, goal: Array32, generator: np.random.Generator, act: Act | None
    ) -> NDArray[np.int64]:
        """Returns the number of steps (batch,) from 1 to `most`, never beyond the episode.

        Args:
            starts: Where the returns begin.
            goal: (batch, goal_size).
            generator: Source of randomness.
            act: (observation, goal) -> what the actor would do; None where it is not asked.
        """
        most: NDArray[np.int64] = np.minimum(starts.last - starts.tick, self.most)
        if self.correction == 'lambda':
            return np.minimum(generator.geometric(1.0 - self.trace, len(most)), most)
        if self.correction == 'cut' and act is not None:
            return self._until_cut(starts, most, goal, act)
        return most

    def _until_cut(
        self, starts: Starts, most: NDArray[np.int64], goal: Array32, act: Act
    ) -> NDArray[np.int64]:
        steps = np.ones_like(most)
        episodes = starts.episodes
        for step in range(1, self.most):
            going = np.flatnonzero((steps == step) & (most > step))
            if not len(going):
                break
            place = starts.row[going], starts.tick[going] + step
            taken, own = episodes.action[place], act(episodes.observation[place], goal[going])
            distance = np.sqrt(np.square(taken - own).mean(axis=-1))
            steps[going[distance <= self.cut_distance]] += 1
        return steps


def discounted_rewards(
    starts: Starts,
    steps: NDArray[np.int64],
    reward_after: Callable[[Array32, NDArray[np.int64]], NDArray[np.float64]],
    gamma: float,
) -> NDArray[np.float64]:
    """Sums of the rewards (batch,) of the first `steps` steps.

    Args:
        starts: Where the returns begin.
        steps: Number of steps, (batch,).
        reward_after: (achieved goals, which transitions) -> rewards.
        gamma: Discount of one step.
    """
    total = np.zeros(len(steps))
    for step in range(int(steps.max(initial=0))):
        chosen = np.flatnonzero(steps > step)
        place = starts.row[chosen], starts.tick[chosen] + step + 1
        total[chosen] += gamma**step * reward_after(starts.episodes.achieved_goal[place], chosen)
    return total
