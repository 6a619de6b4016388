"""Subgoals while episodes are collected: proposed, held for some ticks, sometimes tested.

Every few ticks a high level proposes the goal that the actor pursues until the next proposal. Some
proposals are tested (Levy et al. 2019, "Learning Multi-Level Hierarchies with Hindsight", arXiv
1712.00948): the actor pursues them without noise, so a miss means that the proposal was too hard.
The subgoal and whether it is a test are stored after the action of each tick, so that replay,
checkpoints and workers need no code for them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array32
from policy_node.policies.network_shape import NORMALIZED_CLIP
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.collector import Collector, Observations
from policy_node.training.experience.transitions import Starts

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
        generator: Random generator.
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
            observation: Of all simulations.
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
        actor: Pursues the subgoals.
        proposer: Proposes subgoals.
        every: Ticks for which a subgoal holds.
        ticks: Steps of an episode.

    Attributes:
        actor: Pursues the subgoals.
        proposer: Proposes subgoals.
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
        simulation: The simulations.
        seeds: As for `Collector`.
        config: The configuration.
        every: Ticks for which a subgoal holds.
    """

    def __init__(
        self, simulation: Simulation, seeds: list[int], config: TrainConfig, every: int
    ) -> None:
        columns = subgoal_columns(simulation.spec.goal.size)
        super().__init__(simulation, seeds, config, extra_columns=columns)
        noise = config.learner.exploration
        self._guide = Guide(every, self._generator, noise.noise_std, noise.random_epsilon)
        self._proposer: Proposer | None = None

    def _begin(self, policy: Policy) -> Policy:
        self._guide.share = self.exploration
        self._proposer = None
        if isinstance(policy, GuidedPolicy):
            self._proposer = policy.proposer
            policy = policy.actor
        return super()._begin(policy)

    def _explore(
        self, policy: Policy, observation: Observations, past: Array32, random: bool, tick: int
    ) -> Array32:
        observation = self._guide.lead(observation, None if random else self._proposer, tick)
        if random:
            own = noisy = self._noise.random(tick)
        else:
            own = self._predict(policy, observation, past)
            noisy = self._noise.around(own, tick)
        return self._guide.mark(noisy, own)
