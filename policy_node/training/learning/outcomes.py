"""Goals that another episode brought about: in hindsight, but not of what an episode itself did.

An episode that is replayed for what it achieved itself always succeeds, so that nothing teaches an
on-policy gradient to act at all: leaving the block alone is a success too, and touching it delays
one (`bench/hindsight_pull.py`). Hindsight policy gradients (Rauber et al. 2019, arXiv 1711.06006)
sum over goals that do not depend on the episode. Here these are outcomes of other episodes,
transferred to where this one began; those that would be met there already are left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from policy_node.training.learning.hindsight import OUTCOME, RewardFunction, displace
from policy_node.training.learning.replay import Array, Episodes

# Episodes whose outcomes are drawn from, and states of each.
EPISODES = 2000
_STATES = 4


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What episodes began with, and what they made of it.

    Attributes:
        before: (count, goal_size) achieved in first states.
        after: (count, goal_size) achieved in later ones, which do not meet what was before as a
            goal.
    """

    before: Array
    after: Array

    @classmethod
    def of(
        cls, episodes: Episodes, compute_reward: RewardFunction, generator: np.random.Generator
    ) -> Outcomes:
        """Some states of each episode, without those that changed too little.

        Args:
            episodes: Whose outcomes these are.
            compute_reward: (achieved_goal, desired_goal) -> reward, 0 for success.
            generator: Draws the states.
        """
        row = np.repeat(np.arange(len(episodes)), _STATES)
        tick = generator.integers(1, episodes.ticks + 1, size=len(row))
        before, after = episodes.achieved_goal[row, 0], episodes.achieved_goal[row, tick]
        reward = compute_reward(after.astype(np.float64), before.astype(np.float64))
        changed = np.flatnonzero(np.asarray(reward) < 0.0)
        return cls(before[changed], after[changed])

    def __len__(self) -> int:
        return len(self.after)

    def goals(self, episodes: Episodes, generator: np.random.Generator) -> Array:
        """A goal for each episode as a whole, (episodes, goal_size): any of these outcomes."""
        drawn = generator.integers(len(self), size=len(episodes))
        return displace(episodes.achieved_goal[:, 0], self.before[drawn], self.after[drawn])


def with_outcomes_achieved(mixture: dict[str, float]) -> dict[str, float]:
    """The mixture with achieved goals of the episode for outcomes of others, which are as wide.

    For statistics of goals, which look at one transition at a time.
    """
    if OUTCOME not in mixture:
        return mixture
    found = dict(mixture)
    found['episode'] = found.get('episode', 0.0) + found.pop(OUTCOME)
    return found
