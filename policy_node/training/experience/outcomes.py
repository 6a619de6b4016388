"""Goals that another episode brought about: in hindsight, but not of what an episode itself did.

An episode that is replayed for what it achieved itself always succeeds, so that nothing teaches an
on-policy gradient to act at all: leaving the block alone is a success too, and touching it delays
one (`bench/hindsight_pull.py`). Hindsight policy gradients (Rauber et al. 2019, arXiv 1711.06006)
sum over goals that do not depend on the episode. Here these are outcomes of other episodes,
transferred to where this one began; those that would be met there already are left out. Of a few of
them the nearest to what the episode was asked for is taken (as HGG does, Ren et al. 2019,
arXiv 1906.04279), so that goals grow towards those of the task as the actor can do more.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array32
from policy_node.training.experience.hindsight import OUTCOME, displace
from policy_node.training.experience.replay import Episodes

# Episodes whose outcomes are drawn from, and states of each.
EPISODES = 2000
_STATES = 4
# Outcomes of which the nearest is taken.
_CANDIDATES = 8


@dataclass(frozen=True, slots=True)
class Outcomes:
    """What episodes began with, and what they made of it.

    Attributes:
        before: (count, goal_size) achieved in first states.
        after: (count, goal_size) achieved in later ones, which would not be met by what was before.
        metric: Says what is met, and what is near.
    """

    before: Array32
    after: Array32
    metric: GoalMetric

    @classmethod
    def of(cls, episodes: Episodes, metric: GoalMetric, generator: np.random.Generator) -> Outcomes:
        """Some states of each episode, without those that changed too little.

        Args:
            episodes: Whose outcomes these are.
            metric: Of the task.
            generator: Draws the states.
        """
        row = np.repeat(np.arange(len(episodes)), _STATES)
        tick = generator.integers(1, episodes.ticks + 1, size=len(row))
        before, after = episodes.achieved_goal[row, 0], episodes.achieved_goal[row, tick]
        changed = np.flatnonzero(~metric.success(before, after))
        return cls(before[changed], after[changed], metric)

    def __len__(self) -> int:
        return len(self.after)

    def goals(self, episodes: Episodes, generator: np.random.Generator) -> Array32:
        """A goal for each episode as a whole, (episodes, goal_size)."""
        count = len(episodes)
        drawn = generator.integers(len(self), size=_CANDIDATES * count)
        start = np.tile(episodes.achieved_goal[:, 0], (_CANDIDATES, 1))
        candidates = displace(start, self.before[drawn], self.after[drawn])
        asked = np.tile(episodes.desired_goal, (_CANDIDATES, 1))
        near = self.metric.with_changes(reward_type='dense').reward(candidates, asked)
        best = near.reshape(_CANDIDATES, count).argmax(axis=0)
        goals: Array32 = candidates[best * count + np.arange(count)]
        return goals


def with_outcomes_achieved(mixture: dict[str, float]) -> dict[str, float]:
    """The mixture with achieved goals of the episode for outcomes of others, which are as wide.

    For statistics of goals, which look at one transition at a time.
    """
    if OUTCOME not in mixture:
        return mixture
    found = dict(mixture)
    found['episode'] = found.get('episode', 0.0) + found.pop(OUTCOME)
    return found
