"""Two levels of DDPG: a high level whose actions are goals, and the actor that pursues them.

Levy et al. 2019, "Learning Multi-Level Hierarchies with Hindsight" (HAC, arXiv 1712.00948), on one
replay of whole episodes. The actor learns as in `DDPG`; half of the goals that are not relabelled
are the subgoals that it pursued. In evaluations, the actor pursues the goal itself. So the saved
actor is an ordinary one, and the high level matters only through what the actor has learned.

Any N ticks of an episode are a transition of the high level. Its action is the goal achieved after
these ticks, as if the actor had reached its subgoal. Some subgoals are tested: the actor pursues
them without noise. A tested subgoal that it misses gets the lowest possible value. Otherwise, the
high level would propose goals out of reach. The rewards of the N ticks are discounted tick by tick
and added, so the values of both levels have the same scale.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array32
from msgs_spec.tasks import GoalKind, task_spec
from policy_node.policies.network_shape import NORMALIZED_CLIP, NetworkShape
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.collector import Collector, Observations
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.hindsight import SOURCES
from policy_node.training.experience.replay import Episodes, Starts, Transitions
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.learners.ddpg import DDPG, TensorBatch

# Share of proposals that are tested (Levy et al. 2019).
TESTED = 0.3
_SMALLEST_NORM = 1e-6


def subgoals_of(starts: Starts, generator: np.random.Generator | None = None) -> Array32:
    """Return the subgoals (batch, goal_size) recorded at `starts`; `generator` is unused."""
    del generator
    episodes = starts.episodes
    size = episodes.desired_goal.shape[-1]
    return episodes.action[starts.row, starts.tick, -size - 1 : -1]


@dataclass(frozen=True, slots=True)
class Proposer:
    """A copy of the high level, which proposes subgoals to the actor.

    Attributes:
        policy: Returns actions (N, goal size) in [-1, 1]. They span `NORMALIZED_CLIP` standard
            deviations of goals, the range to which networks clip their input.
        mean: Mean of goals, (goal size,).
        std: Standard deviation of goals, (goal size,).
        is_pose: Whether goals end with a unit quaternion.
    """

    policy: Policy
    mean: Array32
    std: Array32
    is_pose: bool

    def normalized(self, observation: Observations) -> Array32:
        """Return proposed subgoals (N, goal size) in standard deviations from the mean of goals."""
        share: Array32 = self.policy.predict(observation, deterministic=True)[0]
        return NORMALIZED_CLIP * share

    def goals(self, normalized: Array32) -> Array32:
        """Convert the result of `normalized` to goals (N, goal size), float32."""
        goals = self.mean + self.std * normalized
        if self.is_pose:
            norm = np.linalg.norm(goals[:, 3:], axis=-1, keepdims=True)
            goals[:, 3:] /= np.maximum(norm, _SMALLEST_NORM)
        return goals.astype(np.float32)


class GuidedPolicy:
    """Policy of both levels without noise: the actor acts towards subgoals of the high level.

    Args:
        every: Number of ticks for which a subgoal holds.
        ticks: Number of ticks of an episode; after as many calls, `predict` begins a new one.
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
    """Collector whose actor pursues subgoals of a `GuidedPolicy`; both levels have noise.

    The noise on subgoals is in standard deviations of goals. Random subgoals are drawn from a
    normal distribution with the mean and deviation of goals. Each recorded action is followed by
    the subgoal, and by 1 if the subgoal is tested, else 0. Arguments as `Collector`.
    """

    def __init__(self, simulation: Simulation, seeds: list[int], config: TrainConfig) -> None:
        super().__init__(simulation, seeds, config, extra_columns=simulation.spec.goal.size + 1)
        self._config = config
        self._proposer: Proposer | None = None
        self._subgoal: Array32 = np.zeros((0, 0), np.float32)
        self._tested = np.zeros(0, np.bool_)

    def _begin(self, policy: Policy) -> Policy:
        self._proposer = None
        if isinstance(policy, GuidedPolicy):
            self._proposer, policy = policy.proposer, policy.actor
        return super()._begin(policy)

    def _explore(
        self, policy: Policy, observation: Observations, past: Array32, tick: int
    ) -> Array32:
        if tick % self._config.subgoal_every == 0:
            self._propose(observation)
        own = self._predict(policy, {**observation, 'desired_goal': self._subgoal}, past)
        tests = self._tested[:, None]
        # Tests use the actor's own action.
        taken = np.where(tests, own, self._noise.around(own, tick))
        return np.concatenate([taken, self._subgoal, tests], axis=1, dtype=np.float32)

    def _propose(self, observation: Observations) -> None:
        goal = np.asarray(observation['desired_goal'], np.float32)
        self._subgoal, self._tested = goal, np.zeros(len(goal), np.bool_)
        if self._proposer is None:
            return
        generator, config, share = self._generator, self._config, self.exploration
        drawn = generator.standard_normal(goal.shape, dtype=np.float32)
        own = self._proposer.normalized(observation)
        replaced = generator.random(len(goal)) < share * config.random_epsilon
        noisy = own + np.float32(share * config.noise_std) * drawn
        self._subgoal = self._proposer.goals(np.where(replaced[:, None], drawn, noisy))
        self._tested = generator.random(len(goal)) < TESTED


# Share of a batch that begins where a proposal was made. With tests of 0.3 of the proposals about a
# tenth of a batch are penalties if all tests are missed.
_DECISIONS = 0.3
_SUBGOAL = 'subgoal'
# Goal sources of the low level.
LOW_SOURCES = {**SOURCES, _SUBGOAL: subgoals_of}


def with_subgoals(mixture: dict[str, float]) -> dict[str, float]:
    """Return a mixture of goal sources in which `subgoal` takes half of the share of `real`.

    The source `real` keeps the desired goal of the episode. HAC would replace all of its share,
    because the lowest level of HAC never pursues the goal itself.
    """
    kept = mixture.get('real', 0.0) / 2
    return mixture if kept == 0.0 else {**mixture, 'real': kept, _SUBGOAL: kept}


@dataclass(frozen=True, slots=True, kw_only=True)
class HierarchicalTransitions(Transitions):
    """A batch for the actor; `high` is the batch for the high level, whose actions are goals."""

    high: Transitions


@dataclass(frozen=True, slots=True, kw_only=True)
class SubgoalSampler(TransitionSampler):
    """Draws transitions of the high level, each as long as a subgoal holds (`most_steps` ticks).

    The actor pursues tested subgoals without noise. If it missed one, the transition has the reward
    `missed_value`, the lowest possible return, and no value of a next state.
    """

    missed_value: float

    def sample(
        self,
        episodes: Episodes,
        row: NDArray[np.int64],
        mixture: dict[str, float],
        generator: np.random.Generator,
        valid_ticks: NDArray[np.int64] | None = None,
    ) -> Transitions:
        """Draw transitions of the high level; arguments as `TransitionSampler.sample`.

        `valid_ticks` is ignored. Episodes must have at least `most_steps` ticks.
        """
        del valid_ticks
        starts = Starts(episodes, row, self._ticks(episodes, len(row), generator))
        goal = self.relabel(starts, mixture, generator)
        steps = np.full(len(row), self.most_steps)
        batch = self.transitions(starts, steps, goal, generator)
        achieved = episodes.achieved_goal[row, starts.tick + self.most_steps]
        return self._with_tests(starts, replace(batch, action=achieved))

    def _ticks(
        self, episodes: Episodes, count: int, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw the ticks (count,) at which transitions begin.

        The share `_DECISIONS` of them begins at ticks with a new subgoal. The other transitions
        begin at any tick, but `most_steps` before the end of the episode at the latest.
        """
        last, every = episodes.ticks - self.most_steps, self.most_steps
        decision = every * generator.integers(last // every + 1, size=count)
        anywhere = generator.integers(last + 1, size=count)
        return np.where(generator.random(count) < _DECISIONS, decision, anywhere)

    def _with_tests(self, starts: Starts, batch: Transitions) -> Transitions:
        """Return a copy of the batch with a penalty for tested subgoals that were missed.

        Transitions that begin with such a subgoal have it as their action, the reward
        `missed_value` and discount 0.
        """
        subgoal = subgoals_of(starts)
        pairs = batch.action.astype(np.float64), subgoal.astype(np.float64)
        reward = self.compute_reward(*pairs)
        tested = starts.episodes.action[starts.row, starts.tick, -1] > 0.5
        missed = tested & (starts.tick % self.most_steps == 0) & (reward < 0.0)
        return replace(
            batch,
            action=np.where(missed[:, None], subgoal, batch.action),
            reward=np.where(missed, np.float32(self.missed_value), batch.reward),
            discount=batch.discount * ~missed,
        )


class HierarchicalExperience(Experience):
    """Batches of both levels from one replay; arguments as `Experience`."""

    def batch(self) -> HierarchicalTransitions:
        """Draw the transitions of one update of both levels."""
        config, mixture = self.config, self.mixture()
        low = self._draw(with_subgoals(mixture), self.batch_sampler)
        subgoals = SubgoalSampler(
            compute_reward=self._sampler.compute_reward,
            gamma=self._sampler.gamma,
            most_steps=config.subgoal_every,
            reward_scale=self._sampler.reward_scale,
            missed_value=config.lowest_value,
        )
        high = self._draw(mixture, subgoals)
        values = {name: getattr(low, name) for name in Transitions.__slots__}
        values['action'] = low.action[:, : self._spec.robot.action_size]
        return HierarchicalTransitions(**values, high=high)


class HighLevel(DDPG):
    """`DDPG` whose actions are goals for the actor of `low`; both share their normalizers."""

    def __init__(self, shape: NetworkShape, low: DDPG) -> None:
        # A penalty of large actions would prefer goals in the middle of all goals.
        config = replace(low.config, action_l2=0.0)
        shape = replace(shape, action_size=shape.goal_size)
        super().__init__(shape, config, low.device, low.workers, low.critic_loss)
        self.actor.observation_normalizer = low.actor.observation_normalizer
        self.actor.goal_normalizer = low.actor.goal_normalizer
        self._is_pose = task_spec(config.task).goal is GoalKind.POSE

    def tensors(self, batch: Transitions) -> TensorBatch:
        """Convert a batch to tensors as `DDPG` does, with the actions (goals) scaled to [-1, 1]."""
        tensors = super().tensors(batch)
        action = self.actor.goal_normalizer(tensors.action) / NORMALIZED_CLIP
        return replace(tensors, action=action)

    def proposer(self, averaged: bool = False) -> Proposer:
        """Return a CPU copy of this level as a `Proposer`, with averaged weights if `averaged`."""
        actor = self.plain(self.average_actor if averaged else self.actor.network)
        normalizer = actor.goal_normalizer
        return Proposer(actor, normalizer.mean.numpy(), normalizer.std.numpy(), self._is_pose)


class HierarchicalDDPG(DDPG):
    """`DDPG` of the actor, with a `HighLevel` above it; arguments as `DDPG`."""

    def _set_up(self, shape: NetworkShape) -> None:
        self.high = HighLevel(shape, self)
        self.modules |= {f'high_{n}': module for n, module in self.high.modules.items()}
        self.optimizers |= {f'high_{n}': each for n, each in self.high.optimizers.items()}

    def update(self, batch: Transitions) -> Losses:
        """Update both levels on a batch; return the losses of the actor and its critic."""
        assert isinstance(batch, HierarchicalTransitions)
        # A training state contains only the number of updates of the actor.
        self.high.updates = self.updates
        self.high.update(batch.high)
        return super().update(batch)

    def average(self) -> None:
        """Move the averaged actor of each level towards its actor; called once per cycle."""
        super().average()
        self.high.average()

    def set_progress(self, progress: float) -> None:
        """Set the learning rates of both levels for `progress`, the finished share of the run."""
        super().set_progress(progress)
        self.high.set_progress(progress)

    def acting_policy(self) -> Policy:
        """Return both levels as one policy to collect episodes; before any update, the actor."""
        actor = super().acting_policy()
        return self._guided(actor, self.high.proposer()) if self.updates else actor

    def other_policies(self) -> dict[str, Policy]:
        """Return both levels as one policy to evaluate, `eval_guided`; {} before any update."""
        if not self.updates:
            return {}
        both = self._guided(self.evaluation_actor(), self.high.proposer(averaged=True))
        return {'eval_guided': both}

    def _guided(self, actor: Policy, proposer: Proposer) -> GuidedPolicy:
        spec = task_spec(self.config.task, control_hz=self.config.control_hz)
        return GuidedPolicy(actor, proposer, self.config.subgoal_every, spec.episode_ticks)
