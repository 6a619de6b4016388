"""What the high level of a hierarchy learns from: goals as actions, in hindsight what was achieved.

Any N ticks of any episode are a transition of the high level as if the actor were perfect already:
whatever was achieved in them counts as what had been proposed. Proposals that were tested and
missed cost as much as never arriving, or else the high level would ask for what cannot be done
(Levy et al. 2019, arXiv 1712.00948). Rewards of the N ticks add up and are discounted tick by tick,
so that values of both levels have one scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from policy_node.training.configuration.groups import Hierarchical
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import draw_sources, goals_of, with_subgoals
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.experience.subgoals import subgoals_of, tested
from policy_node.training.experience.transitions import Starts, Transitions

# Share of a batch that begins where something was proposed, and may have been tested: with tests of
# 0.3 of the proposals about a tenth of a batch are penalties where all of them are missed.
_DECISIONS = 0.3


@dataclass(frozen=True, slots=True, kw_only=True)
class HierarchicalTransitions(Transitions):
    """A batch for both levels.

    Attributes:
        high: Of the high level, whose actions are goals (batch, goal_size).
    """

    high: Transitions


@dataclass(frozen=True, slots=True)
class SubgoalSampler:
    """How transitions of the high level are made from episodes.

    Attributes:
        sampler: Knows rewards and the discount of one tick.
        every: Ticks for which a subgoal holds.
        missed_value: Value of a tested subgoal that was missed.
    """

    sampler: TransitionSampler
    every: int
    missed_value: float

    def sample(
        self,
        episodes: Episodes,
        row: NDArray[np.int64],
        mixture: dict[str, float],
        generator: np.random.Generator,
    ) -> Transitions:
        """Draws a transition of each chosen episode, its goal relabelled, its action in hindsight.

        Args:
            episodes: Episodes to draw from, no shorter than `every`.
            row: Episode of each transition, (batch,).
            mixture: Probability of each goal source; adds up to 1.
            generator: Source of all randomness.
        """
        starts = Starts(episodes, row, self._ticks(episodes, len(row), generator))
        source = draw_sources(mixture, len(row), generator)
        goal = goals_of(starts, source, list(mixture), generator)
        batch = self.sampler.several(starts, np.full(len(row), self.every), goal, generator)
        achieved = episodes.achieved_goal[row, starts.tick + self.every]
        return self._with_tests(starts, replace(batch, action=achieved))

    def _ticks(
        self, episodes: Episodes, count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Where transitions begin, (count,): anywhere, a share of them where one was proposed."""
        last = episodes.ticks - self.every
        decision = self.every * generator.integers(last // self.every + 1, size=count)
        anywhere = generator.integers(last + 1, size=count)
        return np.where(generator.random(count) < _DECISIONS, decision, anywhere)

    def _with_tests(self, starts: Starts, batch: Transitions) -> Transitions:
        """The batch, where missed subgoals that were tested lead nowhere, whatever the goal is."""
        subgoal = subgoals_of(starts)
        pairs = batch.action.astype(np.float64), subgoal.astype(np.float64)
        reward = self.sampler.compute_reward(*pairs)
        missed = tested(starts) & (starts.tick % self.every == 0) & (reward < 0.0)
        return replace(
            batch,
            action=np.where(missed[:, None], subgoal, batch.action),
            reward=np.where(missed, np.float32(self.missed_value), batch.reward),
            discount=batch.discount * ~missed,
        )


class HierarchicalExperience(Experience):
    """Batches of both levels from one replay; arguments as `Experience` has them."""

    def batch(self, env_steps: int) -> HierarchicalTransitions:
        """Draws the transitions of one update of both levels."""
        del env_steps
        config, mixture = self.config, self.mixture()
        assert isinstance(config.learner, Hierarchical)
        every = config.learner.subgoal_every
        low = self._draw(with_subgoals(mixture))
        rows = self._draw_rows()
        subgoals = SubgoalSampler(self._sampler, every, config.lowest_value)
        high = subgoals.sample(self.replay.episodes, rows, mixture, self.generator)
        values = {name: getattr(low, name) for name in Transitions.__slots__}
        values['action'] = low.action[:, : self._spec.robot.action_size]
        return HierarchicalTransitions(**values, high=high)
