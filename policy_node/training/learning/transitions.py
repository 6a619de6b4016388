"""The transitions of one update: drawn from whole episodes, their goals exchanged."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from policy_node.training.learning.hindsight import RewardFunction, relabel
from policy_node.training.learning.replay import Array, Episodes


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch for one update, float32; the target of a value is reward + discount * next value.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size).
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`.
        discount: (batch,) of the value of the next state.
    """

    observation: Array
    next_observation: Array
    goal: Array
    action: Array
    reward: Array
    discount: Array


@dataclass(frozen=True, slots=True)
class TransitionSampler:
    """How transitions are made from episodes.

    Attributes:
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        gamma: Discount of one step.
    """

    compute_reward: RewardFunction
    gamma: float

    def sample(
        self,
        episodes: Episodes,
        row: NDArray[np.int64],
        mixture: dict[str, float],
        generator: np.random.Generator,
        valid_ticks: NDArray[np.int64] | None = None,
    ) -> Transitions:
        """Draws a transition of each chosen episode and relabels its goal.

        Args:
            episodes: Episodes to draw from.
            row: Episode of each transition, (batch,).
            mixture: Probability of each goal source; adds up to 1.
            generator: Source of all randomness.
            valid_ticks: Ticks of each episode, from its first, that transitions and achieved goals
                are drawn from; None is all.
        """
        ticks = episodes.ticks
        if valid_ticks is None:
            tick = generator.integers(ticks, size=len(row))
        else:
            tick = generator.integers(valid_ticks.take(row))
        goal = relabel(episodes, row, tick, mixture, generator, valid_ticks)
        state = row * (ticks + 1) + tick
        observation = flat(episodes.observation)
        achieved = flat(episodes.achieved_goal).take(state + 1, axis=0)
        reward = self.compute_reward(achieved.astype(np.float64), goal.astype(np.float64))
        return Transitions(
            observation=observation.take(state, axis=0),
            next_observation=observation.take(state + 1, axis=0),
            goal=goal,
            action=flat(episodes.action).take(row * ticks + tick, axis=0),
            reward=np.asarray(reward, dtype=np.float32),
            discount=np.full(len(row), self.gamma, np.float32),
        )


def flat(values: Array) -> Array:
    """Rows of all episodes, one after the other."""
    return values.reshape(-1, values.shape[-1])
