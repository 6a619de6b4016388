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

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import nn

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array32
from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.collector import Collector, Observations
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import SOURCES, draw_sources, goals_of
from policy_node.training.experience.replay import Episodes, Starts, Transitions
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.learners.ddpg import DDPG, Parts, TensorBatch
from policy_node.training.machine import Workers

# Share of proposals that are tested (Levy et al. 2019).
TESTED = 0.3
_SMALLEST_NORM = 1e-6


def subgoal_columns(goal_size: int) -> int:
    """Return the number of values after an action: the subgoal and whether it is tested."""
    return goal_size + 1


def subgoals_of(starts: Starts, generator: np.random.Generator | None = None) -> Array32:
    """Return the subgoals (batch, goal_size) that were pursued where transitions begin."""
    del generator
    episodes = starts.episodes
    size = episodes.desired_goal.shape[-1]
    return episodes.action[starts.row, starts.tick, -size - 1 : -1]


def tested(starts: Starts) -> NDArray[np.bool_]:
    """Return whether transitions begin in a test, (batch,)."""
    return np.asarray(starts.episodes.action[starts.row, starts.tick, -1] > 0.5)


@dataclass(frozen=True, slots=True)
class Proposer:
    """A high level that proposes goals.

    Attributes:
        policy: Its actions (N, goal size) in [-1, 1] span `NORMALIZED_CLIP` standard deviations of
            goals, the range that the networks can distinguish.
        mean: Mean of goals, (goal size,).
        std: Standard deviation of goals, (goal size,).
        is_pose: Whether goals end with a unit quaternion.
    """

    policy: Policy
    mean: Array32
    std: Array32
    is_pose: bool

    def normalized(self, observation: Mapping[str, ArrayLike]) -> Array32:
        """Return proposals (N, goal size) in standard deviations from the mean."""
        share: Array32 = self.policy.predict(observation, deterministic=True)[0]
        return NORMALIZED_CLIP * share

    def goals(self, normalized: Array32) -> Array32:
        """Return goals (N, goal size), float32, from standard deviations from the mean."""
        goals = self.mean + self.std * normalized
        if self.is_pose:
            norm = np.linalg.norm(goals[:, 3:], axis=-1, keepdims=True)
            goals[:, 3:] /= np.maximum(norm, _SMALLEST_NORM)
        return goals.astype(np.float32)


class Guide:
    """Replaces the goals of the actor by subgoals, in each of several simulations.

    Args:
        every: Ticks for which a subgoal holds.
        noise_std: Standard deviation of the noise on proposals, in standard deviations of goals.
        random_epsilon: Probability of a random goal instead, each value normal with the mean and
            deviation of goals.

    Attributes:
        share: Factor on `noise_std` and `random_epsilon`, 0 ... 1.
    """

    def __init__(
        self, every: int, generator: np.random.Generator, noise_std: float, random_epsilon: float
    ) -> None:
        self._every = every
        self._generator = generator
        self._std, self._epsilon = noise_std, random_epsilon
        self.share = 1.0
        self._subgoal: Array32 = np.zeros((0, 0), np.float32)
        self._tested = np.zeros(0, np.bool_)

    def lead(
        self, observation: Mapping[str, ArrayLike], proposer: Proposer | None, tick: int
    ) -> dict[str, ArrayLike]:
        """Return the observation with the subgoal as the desired goal.

        Args:
            proposer: The high level; with None the subgoal is the goal itself and never tested.
            tick: Tick of the episode.
        """
        if tick % self._every == 0:
            self._subgoal = np.asarray(observation['desired_goal'], np.float32)
            self._tested = np.zeros(len(self._subgoal), np.bool_)
            if proposer is not None:
                self._propose(observation, proposer)
        return {**observation, 'desired_goal': self._subgoal}

    def _propose(self, observation: Mapping[str, ArrayLike], proposer: Proposer) -> None:
        generator, count = self._generator, len(self._subgoal)
        drawn = generator.standard_normal(self._subgoal.shape, dtype=np.float32)
        own = proposer.normalized(observation)
        replaced = generator.random(count) < self.share * self._epsilon
        noisy = own + np.float32(self.share * self._std) * drawn
        self._subgoal = proposer.goals(np.where(replaced[:, None], drawn, noisy))
        self._tested = generator.random(count) < TESTED

    def mark(self, noisy: Array32, own: Array32) -> Array32:
        """Return actions (N, action size + goal size + 1); tests use the actor's own action.

        Args:
            noisy: Actions with noise, (N, action size).
            own: Actions of the actor, (N, action size).
        """
        tests = self._tested[:, None]
        taken = np.where(tests, own, noisy)
        return np.concatenate([taken, self._subgoal, tests], axis=1, dtype=np.float32)


class GuidedPolicy:
    """Actor and high level as one policy without noise, for whole episodes.

    Args:
        every: Ticks for which a subgoal holds.
    """

    def __init__(self, actor: Policy, proposer: Proposer, every: int, ticks: int) -> None:
        self.actor, self.proposer = actor, proposer
        self._every, self._ticks = every, ticks
        self._tick = 0
        self._subgoal: Array32 = np.zeros((0, 0), np.float32)

    def predict(
        self,
        observation: Mapping[str, ArrayLike],
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[np.float32], Any]:
        """Return actions (N, action size) for observations (N, ...) of the next tick."""
        del episode_start
        proposer = self.proposer
        if self._tick % self._every == 0:
            self._subgoal = proposer.goals(proposer.normalized(observation))
        self._tick = (self._tick + 1) % self._ticks
        pursued = {**observation, 'desired_goal': self._subgoal}
        return self.actor.predict(pursued, state, deterministic=deterministic)


class GuidedCollector(Collector):
    """Collects with a `GuidedPolicy`; its proposals get noise, too.

    Args:
        seeds: As for `Collector`.
        every: Ticks for which a subgoal holds.
    """

    def __init__(
        self, simulation: Simulation, seeds: list[int], config: TrainConfig, every: int
    ) -> None:
        columns = subgoal_columns(simulation.spec.goal.size)
        super().__init__(simulation, seeds, config, extra_columns=columns)
        self._guide = Guide(every, self._generator, config.noise_std, config.random_epsilon)
        self._proposer: Proposer | None = None

    def _begin(self, policy: Policy) -> Policy:
        self._guide.share = self.exploration
        self._proposer = None
        if isinstance(policy, GuidedPolicy):
            self._proposer = policy.proposer
            policy = policy.actor
        return super()._begin(policy)

    def _explore(
        self, policy: Policy, observation: Observations, past: Array32, tick: int
    ) -> Array32:
        observation = self._guide.lead(observation, self._proposer, tick)
        own = self._predict(policy, observation, past)
        return self._guide.mark(self._noise.around(own, tick), own)


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
        every = config.subgoal_every
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
        parts: As for `DDPG`.
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
        config = replace(config, action_l2=0.0)
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
    """The actor, which learns as in `DDPG`, and a high level; arguments as `DDPG`."""

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
        spec = task_spec(self.config.task, control_hz=self.config.control_hz)
        return GuidedPolicy(actor, proposer, self.config.subgoal_every, spec.episode_ticks)

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules that a training state contains, by name."""
        high = {f'{_HIGH}{name}': module for name, module in self.high.modules().items()}
        return {**super().modules(), **high}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """Return the optimizers whose states a training state contains, by name."""
        high = {f'{_HIGH}{name}': value for name, value in self.high.optimizers().items()}
        return {**super().optimizers(), **high}
