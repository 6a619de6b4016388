"""Subgoals while episodes are collected: what proposes them, how long they hold, which are tested.

A high level says every so many ticks which goal the actor is to pursue until the next proposal.
Now and then a proposal is tested (Levy et al. 2019, "Learning Multi-Level Hierarchies with
Hindsight", arXiv 1712.00948): the actor then goes for it without noise, so that missing it says
something about the proposal. What was pursued and whether it was a test follow the action in the
arrays of an episode, tick by tick, so that replay, checkpoints and workers need not know of them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.arrays import Array32
from policy_node.policies.network_shape import NORMALIZED_CLIP
from policy_node.policies.policy import Policy
from policy_node.training.experience.transitions import Starts

# Share of proposals that are tested (Levy et al. 2019).
TESTED = 0.3
_SMALLEST_NORM = 1e-6


def subgoal_columns(every: int, goal_size: int) -> int:
    """Numbers that follow an action: the subgoal and whether it is tested; none without one."""
    return goal_size + 1 if every else 0


def subgoals_of(starts: Starts) -> Array32:
    """The subgoals (batch, goal_size) that were pursued where transitions begin."""
    episodes = starts.episodes
    size = episodes.desired_goal.shape[-1]
    return episodes.action[starts.row, starts.tick, -size - 1 : -1]


def tested(starts: Starts) -> NDArray[np.bool_]:
    """Whether these were tests, (batch,)."""
    return np.asarray(starts.episodes.action[starts.row, starts.tick, -1] > 0.5)


@dataclass(frozen=True, slots=True)
class Proposer:
    """A high level as it acts: its actions are goals.

    Attributes:
        policy: Its actions (N, goal size) in [-1, 1] span `NORMALIZED_CLIP` standard deviations of
            goals, beyond which no network tells them apart.
        mean: Mean of goals, (goal size,).
        std: Their standard deviation, likewise.
        is_pose: Whether they end with a unit quaternion.
    """

    policy: Policy
    mean: Array32
    std: Array32
    is_pose: bool

    def normalized(self, observation: Mapping[str, ArrayLike]) -> Array32:
        """What it proposes, (N, goal size), in standard deviations from the mean."""
        share: Array32 = self.policy.predict(observation, deterministic=True)[0]
        return NORMALIZED_CLIP * share

    def goals(self, normalized: Array32) -> Array32:
        """Goals (N, goal size), float32, that lie so many standard deviations from the mean."""
        goals = self.mean + self.std * normalized
        if self.is_pose:
            norm = np.linalg.norm(goals[:, 3:], axis=-1, keepdims=True)
            goals[:, 3:] /= np.maximum(norm, _SMALLEST_NORM)
        return goals.astype(np.float32)


class Guide:
    """Gives the actor subgoals instead of goals, in each of several simulations.

    Args:
        every: Ticks for which a subgoal holds.
        generator: Source of all randomness.
        noise_std: Standard deviation of the noise on proposals, in standard deviations of goals.
        random_epsilon: Probability of a goal drawn like those seen instead, each number by itself.

    Attributes:
        share: Share of `noise_std` and `random_epsilon` that is in force.
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
        """Returns the observation with the subgoal as the desired goal.

        Args:
            observation: Of all simulations.
            proposer: Who proposes; without one the goal itself is pursued, and nothing tested.
            tick: Of the episode.
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
        """Actions (N, action size + goal size + 1): of tests the actor's own; then the subgoals.

        Args:
            noisy: Actions with noise, (N, action size).
            own: Those of the actor.
        """
        tests = self._tested[:, None]
        taken = np.where(tests, own, noisy)
        return np.concatenate([taken, self._subgoal, tests], axis=1, dtype=np.float32)


class GuidedPolicy:
    """Actor and high level as one policy, without noise, for whole episodes from their first tick.

    Args:
        actor: Pursues what is proposed.
        proposer: Proposes.
        every: Ticks for which a subgoal holds.
        ticks: Steps of an episode.
    """

    def __init__(self, actor: Policy, proposer: Proposer, every: int, ticks: int) -> None:
        self._actor, self._proposer = actor, proposer
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
        if self._tick % self._every == 0:
            proposer = self._proposer
            self._subgoal = proposer.goals(proposer.normalized(observation))
        self._tick = (self._tick + 1) % self._ticks
        pursued = {**observation, 'desired_goal': self._subgoal}
        del episode_start
        return self._actor.predict(pursued, state, deterministic=deterministic)
