"""Two levels of DDPG: a high level whose actions are goals, and the actor that pursues them.

Levy et al. 2019, "Learning Multi-Level Hierarchies with Hindsight" (HAC, arXiv 1712.00948), on one
replay of whole episodes. The actor learns as in `DDPG`; half of the goals that are not relabelled
are the subgoals that it pursued. Evaluation and the saved actor use the goal itself: then the actor
is an ordinary one, and the benefit of the high level is what the actor has learned.

Any N ticks of an episode are a transition of the high level, as if the actor were perfect: its
action is the goal achieved after them. Tested proposals that were missed cost as much as never
arriving, or the high level would propose the impossible. The rewards of the N ticks are discounted
tick by tick and added, so the values of both levels have the same scale.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn

from msgs_spec.arrays import Array32
from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Hierarchical
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import SOURCES, draw_sources, goals_of
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.experience.transitions import Starts, Transitions
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.learners.ddpg import DDPG, Parts, TensorBatch
from policy_node.training.machine.distributed import Workers
from policy_node.training.research.subgoals import GuidedPolicy, Proposer, subgoals_of, tested

# Share of a batch that begins where a proposal was made. With tests of 0.3 of the proposals about a
# tenth of a batch are penalties if all tests are missed.
_DECISIONS = 0.3
_SUBGOAL = 'subgoal'
# Goal sources of the low level.
LOW_SOURCES = {**SOURCES, _SUBGOAL: subgoals_of}
# Prefix of the parts of the high level in a training state.
_HIGH = 'high_'


def with_subgoals(mixture: dict[str, float]) -> dict[str, float]:
    """Return the mixture with half of the goals of episodes replaced by subgoals.

    HAC would replace all, but its lowest level never gets the goal itself.
    """
    kept = mixture.get('real', 0.0) / 2
    return mixture if kept == 0.0 else {**mixture, 'real': kept, _SUBGOAL: kept}


@dataclass(frozen=True, slots=True, kw_only=True)
class HierarchicalTransitions(Transitions):
    """A batch for both levels.

    Attributes:
        high: Batch of the high level, whose actions are goals (batch, goal_size).
    """

    high: Transitions


@dataclass(frozen=True, slots=True)
class SubgoalSampler:
    """Makes transitions of the high level.

    Attributes:
        sampler: Computes rewards and has the discount of one tick.
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
        """Draw a transition of each chosen episode with relabelled goal and hindsight action.

        Args:
            episodes: Episodes to draw from, no shorter than `every`.
            row: Episode of each transition, (batch,).
            mixture: Probability of each goal source; adds up to 1.
            generator: Random generator.
        """
        starts = Starts(episodes, row, self._ticks(episodes, len(row), generator))
        source = draw_sources(mixture, len(row), generator)
        goal = goals_of(starts, source, list(mixture), generator)

        def reward_after(achieved: Array32, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
            goals = achieved.astype(np.float64), goal[chosen].astype(np.float64)
            return np.asarray(self.sampler.compute_reward(*goals))

        steps = np.full(len(row), self.every)
        batch = self.sampler.several(starts, steps, goal, reward_after)
        achieved = episodes.achieved_goal[row, starts.tick + self.every]
        return self._with_tests(starts, replace(batch, action=achieved))

    def _ticks(
        self, episodes: Episodes, count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw the first ticks (count,): a share of them where a proposal was made."""
        last = episodes.ticks - self.every
        decision = self.every * generator.integers(last // self.every + 1, size=count)
        anywhere = generator.integers(last + 1, size=count)
        return np.where(generator.random(count) < _DECISIONS, decision, anywhere)

    def _with_tests(self, starts: Starts, batch: Transitions) -> Transitions:
        """Return the batch; missed tests have the lowest value for any goal."""
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
    """Batches of both levels from one replay; arguments as `Experience`."""

    def batch(self, env_steps: int) -> HierarchicalTransitions:
        """Draw the transitions of one update of both levels."""
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


class HighLevel(DDPG):
    """The learner of the high level: its actions are goals.

    Args:
        shape: Shape of the low level.
        config: The configuration.
        device: Device of the networks.
        workers: This worker among all.
        parts: As for `DDPG`.
        actor: Actor of the low level, whose normalizers are shared.
    """

    def __init__(
        self,
        shape: NetworkShape,
        config: TrainConfig,
        device: torch.device,
        workers: Workers,
        parts: Parts | None,
        actor: Actor,
    ) -> None:
        shape = replace(shape, action_size=shape.goal_size)
        # A penalty of large actions would prefer goals in the middle of all goals.
        config = replace(config, learner=replace(config.learner, action_l2=0.0))
        super().__init__(shape, config, device, workers, parts)
        self.actor.observation_normalizer = actor.observation_normalizer
        self.actor.goal_normalizer = actor.goal_normalizer
        self._is_pose = task_spec(config.task).goal is GoalKind.POSE

    def tensors(self, batch: Transitions) -> TensorBatch:
        """As `DDPG`, with goals as actions in [-1, 1]."""
        tensors = super().tensors(batch)
        action = self.actor.goal_normalizer(tensors.action) / NORMALIZED_CLIP
        return replace(tensors, action=action)

    def proposer(self, averaged: bool = False) -> Proposer:
        """Return a copy on the CPU that proposes goals."""
        actor = self.plain(self.average_actor if averaged else self.actor.network)
        normalizer = actor.goal_normalizer
        return Proposer(actor, normalizer.mean.numpy(), normalizer.std.numpy(), self._is_pose)


class HierarchicalDDPG(DDPG):
    """The actor, which learns as in `DDPG`, and a high level; arguments as `DDPG`.

    Attributes:
        high: The high level.
    """

    def __init__(
        self,
        shape: NetworkShape,
        config: TrainConfig,
        device: torch.device,
        workers: Workers,
        parts: Parts | None = None,
    ) -> None:
        super().__init__(shape, config, device, workers, parts)
        self.high = HighLevel(shape, config, device, workers, parts, self.actor)

    def update(self, batch: Transitions) -> Losses:
        """Improve both levels on a batch and return the losses of the actor.

        Raises:
            TypeError: If the batch has no transitions of the high level.
        """
        if not isinstance(batch, HierarchicalTransitions):
            found = type(batch).__name__
            raise TypeError(f'two levels learn from HierarchicalTransitions, not {found}')
        # A training state contains only the number of updates of the actor.
        self.high.updates = self.updates
        self.high.update(batch.high)
        return super().update(batch)

    def average(self) -> None:
        """As `ActorCritic`, both levels."""
        super().average()
        self.high.average()

    def set_progress(self, progress: float) -> None:
        """As `ActorCritic`, both levels."""
        super().set_progress(progress)
        self.high.set_progress(progress)

    def acting_policy(self) -> Policy:
        """Return the policy that collects; before the first update the actor alone."""
        actor = super().acting_policy()
        return self._guided(actor, self.high.proposer()) if self.updates else actor

    def other_policies(self) -> dict[str, Policy]:
        """Return both levels as one policy."""
        if not self.updates:
            return {}
        both = self._guided(self.evaluation_actor(), self.high.proposer(averaged=True))
        return {'eval_guided': both}

    def _guided(self, actor: Policy, proposer: Proposer) -> GuidedPolicy:
        assert isinstance(self.options, Hierarchical)
        spec = task_spec(self.config.task, control_hz=self.config.collect.control_hz)
        return GuidedPolicy(actor, proposer, self.options.subgoal_every, spec.episode_ticks)

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules that a training state contains, by name."""
        high = {f'{_HIGH}{name}': module for name, module in self.high.modules().items()}
        return {**super().modules(), **high}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """Return the optimizers whose states a training state contains, by name."""
        high = {f'{_HIGH}{name}': value for name, value in self.high.optimizers().items()}
        return {**super().optimizers(), **high}
