"""Rollouts of the actor that learns: goals exchanged, advantages, and what hindsight distorts.

An on-policy gradient asks what the actor would do for the goal in question. An episode collected
for a goal g and replayed for g' has actions that are those for g. `importance=none` takes that for
good (as PPO-HER, arXiv 2410.22524); `decision` weighs each transition of a replayed episode with

    w_t = prod_{k <= t} pi(a_k | s_k, g') / pi(a_k | s_k, g),

the per-decision weight of hindsight policy gradients (Rauber et al. 2019, arXiv 1711.06006),
normalised tick by tick over the replayed episodes, as they propose. What comes after a transition
depends on later actions, which were for g as well: in its advantage each later error weighs the
ratios of the actions between, cut as in V-trace (Espeholt et al. 2018, arXiv 1802.01561).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array, Array32
from policy_node.training.experience.hindsight import (
    OUTCOME,
    RewardFunction,
    draw_sources,
    goals_of,
)
from policy_node.training.experience.outcomes import Outcomes
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.transitions import Starts, Transitions

_SMALLEST_DEVIATION = 1e-6
# Largest weight of an error, by the ratio of its action, and of what follows, by those of the
# actions before it: the second only makes traces shorter.
_LARGEST_RATIO, _LARGEST_TRACE = 10.0, 1.0


class Critique(Protocol):
    """What a learner says of states, and of actions taken in them."""

    def values(self, observation: Array32, goal: Array32) -> Array32:
        """Values (...,) of states (..., observation_size) for goals (..., goal_size)."""
        ...

    def log_probabilities(self, observation: Array32, goal: Array32, action: Array32) -> Array32:
        """Logarithms (...,) of the densities of actions (..., action_size)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutTransitions(Transitions):
    """Transitions of the newest rollouts.

    Attributes:
        log_probability: (batch,) of the action, by the actor before the first update that draws
            from the rollouts. Its networks collected it; its normalisers have learnt from the
            episodes since, which matters in the first cycles of a run.
        advantage: (batch,) of the action over what that actor gets, of deviation 1.
        value_target: (batch,) what the state is worth.
        weight: (batch,) of the transition in all losses.
    """

    log_probability: Array32
    advantage: Array32
    value_target: Array32
    weight: Array32


@dataclass(frozen=True, slots=True)
class Rollouts:
    """Episodes of T steps, and what there is to learn from them under the goals they have.

    Attributes:
        episodes: The episodes.
        reward: (episodes, T).
        log_probability: (episodes, T) of the actions.
        advantage: (episodes, T).
        value_target: (episodes, T).
        weight: (episodes, T).
    """

    episodes: Episodes
    reward: Array32
    log_probability: Array32
    advantage: Array32
    value_target: Array32
    weight: Array32

    def draw(
        self, row: NDArray[np.int64], gamma: float, generator: np.random.Generator
    ) -> RolloutTransitions:
        """Draws a transition from each of these episodes, (batch,)."""
        episodes, count = self.episodes, len(row)
        tick = generator.integers(episodes.ticks, size=count)
        return RolloutTransitions(
            observation=episodes.observation[row, tick],
            next_observation=episodes.observation[row, tick + 1],
            goal=episodes.desired_goal[row],
            action=episodes.action[row, tick],
            reward=self.reward[row, tick],
            discount=np.full(count, gamma, np.float32),
            log_probability=self.log_probability[row, tick],
            advantage=self.advantage[row, tick],
            value_target=self.value_target[row, tick],
            weight=self.weight[row, tick],
        )


@dataclass(frozen=True, slots=True)
class RolloutMaker:
    """Makes rollouts of episodes.

    Attributes:
        critique: Of the actor that collected them.
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        gamma: Discount of one step.
        trace: Lambda of the advantages.
        corrects: Whether replayed episodes are weighed per decision.
    """

    critique: Critique
    compute_reward: RewardFunction
    gamma: float
    trace: float
    corrects: bool

    def make(self, episodes: Episodes, goals: Sequence[Array32]) -> Rollouts:
        """Rollouts of episodes with their own goals, and once more with each of others.

        Args:
            episodes: As they were collected.
            goals: Goals (episodes, goal_size) to replay them for.
        """
        own = self._under(episodes)
        meant = own.log_probability if self.corrects else None
        replayed = [self._under(replace(episodes, desired_goal=goal), meant) for goal in goals]
        if self.corrects and replayed:
            logs = [rollouts.log_probability - own.log_probability for rollouts in replayed]
            weights = np.split(decision_weights(np.concatenate(logs)), len(logs))
            replayed = [
                replace(rollouts, weight=weight.astype(np.float32))
                for rollouts, weight in zip(replayed, weights, strict=True)
            ]
        return _joined([own, *replayed])

    def _under(self, episodes: Episodes, meant: Array32 | None = None) -> Rollouts:
        """Rollouts under the goals that the episodes have.

        Args:
            episodes: The episodes.
            meant: (episodes, T) log probabilities of the actions for the goals that they were for;
                None takes them as if they had been for these.
        """
        count, ticks = len(episodes), episodes.ticks
        goal = np.repeat(episodes.desired_goal[:, None], ticks + 1, axis=1)
        achieved = episodes.achieved_goal[:, 1:].astype(np.float64)
        reward = np.asarray(self.compute_reward(achieved, goal[:, 1:].astype(np.float64)))
        value = self.critique.values(episodes.observation, goal).astype(np.float64)
        states = episodes.observation[:, :-1], goal[:, :-1]
        log_probability = self.critique.log_probabilities(*states, episodes.action)
        log_ratio = None if meant is None else log_probability - meant
        advantage = advantages(reward, value, self.gamma, self.trace, log_ratio)
        return Rollouts(
            episodes,
            reward.astype(np.float32),
            log_probability,
            advantage.astype(np.float32),
            (advantage + value[:, :-1]).astype(np.float32),
            np.ones((count, ticks), np.float32),
        )


def advantages(
    reward: Array,
    value: Array,
    gamma: float,
    trace: float,
    log_ratio: NDArray[np.floating] | None = None,
) -> Array:
    """Generalised advantages (Schulman et al. 2016, arXiv 1506.02438), (episodes, T).

    Args:
        reward: (episodes, T).
        value: (episodes, T + 1); episodes are cut, never terminated, so the last counts.
        gamma: Discount of one step.
        trace: Lambda.
        log_ratio: (episodes, T) log pi(a | s, g') - log pi(a | s, g) of actions that were for
            another goal g; None where they were for this one.
    """
    error = reward + gamma * value[:, 1:] - value[:, :-1]
    ratio = np.ones_like(error)
    if log_ratio is not None:
        ratio = np.exp(np.minimum(log_ratio, np.log(_LARGEST_RATIO), dtype=np.float64))
    found = np.zeros_like(error)
    # What the ticks from here on add to the value of their first state.
    following = np.zeros(len(error))
    for tick in reversed(range(error.shape[1])):
        found[:, tick] = error[:, tick] + gamma * trace * following
        cut = np.minimum(ratio[:, tick], _LARGEST_TRACE)
        following = ratio[:, tick] * error[:, tick] + gamma * trace * cut * following
    return found


def decision_weights(log_ratio: NDArray[np.floating]) -> Array:
    """Per-decision weights (episodes, T) of mean 1 at each tick.

    Args:
        log_ratio: (episodes, T) log pi(a | s, g') - log pi(a | s, g).
    """
    logs = np.cumsum(log_ratio, axis=1, dtype=np.float64)
    weight = np.exp(logs - logs.max(axis=0))
    return np.asarray(weight / weight.mean(axis=0))


def goals_in_hindsight(
    episodes: Episodes,
    mixture: dict[str, float],
    generator: np.random.Generator,
    outcomes: Outcomes | None = None,
) -> Array32:
    """A goal for each episode as a whole, (episodes, goal_size), from the sources of a mixture.

    Args:
        episodes: The episodes.
        mixture: Probability of each source.
        generator: Source of all randomness.
        outcomes: Of other episodes, where the mixture has them; while there are none, an episode
            keeps its goal.
    """
    count, names = len(episodes), list(mixture)
    starts = Starts(episodes, np.arange(count), np.zeros(count, np.int64))
    source = draw_sources(mixture, count, generator)
    sources = ['real' if name == OUTCOME else name for name in names]
    goal = goals_of(starts, source, sources, generator)
    if outcomes is None or not len(outcomes):
        return goal
    transferred = np.flatnonzero(np.array(names)[source] == OUTCOME)
    goal[transferred] = outcomes.goals(episodes, generator)[transferred]
    return goal


def _joined(parts: Sequence[Rollouts]) -> Rollouts:
    """All of them, with advantages of weighted mean 0 and deviation 1."""
    episodes = Episodes(
        *(
            np.concatenate([getattr(part.episodes, name) for part in parts])
            for name in Episodes.__slots__
        )
    )
    reward, log_probability, advantage, target, weight = (
        np.concatenate([getattr(part, name) for part in parts])
        for name in Rollouts.__slots__
        if name != 'episodes'
    )
    mean = np.average(advantage, weights=weight)
    deviation = np.sqrt(np.average(np.square(advantage - mean), weights=weight))
    advantage = ((advantage - mean) / max(deviation, _SMALLEST_DEVIATION)).astype(np.float32)
    return Rollouts(episodes, reward, log_probability, advantage, target, weight)
