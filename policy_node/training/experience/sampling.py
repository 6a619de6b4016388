"""Make transitions from whole episodes: draw states, relabel goals, recompute rewards."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array32
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.hindsight import (
    SOURCES,
    RewardFunction,
    Source,
    draw_sources,
    flat,
    goals_of,
)
from policy_node.training.experience.replay import Episodes, Starts, Transitions
from policy_node.training.experience.rewards import reward_schedule

RewardAfter = Callable[[Array32, NDArray[np.int64]], NDArray[np.float64]]
"""A function from achieved goals and the indices of their transitions to rewards."""


@dataclass(frozen=True, slots=True)
class TransitionSampler:
    """Makes transitions from episodes.

    Attributes:
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
        lost_value: Value after the last valid tick of an episode; None bootstraps as usual.
        reward_at: Progress, 0 ... 1 -> `compute_reward` at that time; None if it never changes.
    """

    compute_reward: RewardFunction
    gamma: float
    most_steps: int = 1
    reward_scale: float = 1.0
    lost_value: float | None = None
    reward_at: Callable[[float], RewardFunction] | None = None
    sources: Mapping[str, Source] = field(default_factory=lambda: SOURCES)

    def at(self, progress: float) -> TransitionSampler:
        """Return the sampler with the reward at this progress of the run, 0 ... 1."""
        if self.reward_at is None:
            return self
        return replace(self, compute_reward=self.reward_at(progress))

    def sample(
        self,
        episodes: Episodes,
        row: NDArray[np.int64],
        mixture: dict[str, float],
        generator: np.random.Generator,
        valid_ticks: NDArray[np.int64] | None = None,
    ) -> Transitions:
        """Draw a transition of each chosen episode and relabel its goal.

        Args:
            row: Episode of each transition, (batch,).
            mixture: Probability of each goal source; adds up to 1.
            valid_ticks: Number of ticks of each episode that count, from its first; None is all.
        """
        if valid_ticks is None:
            tick = generator.integers(episodes.ticks, size=len(row))
        else:
            tick = generator.integers(valid_ticks.take(row))
        starts = Starts(episodes, row, tick, valid_ticks)
        goal = self.relabel(starts, mixture, generator)
        steps = self.steps(starts, goal, generator)
        batch = self.transitions(starts, steps, goal, generator)
        if self.lost_value is None:
            return batch
        return _with_losses(starts, steps, batch, self.lost_value)

    def relabel(
        self, starts: Starts, mixture: dict[str, float], generator: np.random.Generator
    ) -> Array32:
        """Draw the goals (batch, goal_size) of transitions from the sources of a mixture."""
        source = draw_sources(mixture, len(starts.row), generator)
        return goals_of(starts, source, list(mixture), generator, self.sources)

    def steps(
        self, starts: Starts, goal: Array32, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return the steps (batch,) of each return, 1 ... `most_steps`, within the episode."""
        del goal, generator
        steps: NDArray[np.int64] = np.minimum(starts.last - starts.tick, self.most_steps)
        return steps

    def transitions(
        self,
        starts: Starts,
        steps: NDArray[np.int64],
        goal: Array32,
        generator: np.random.Generator,
    ) -> Transitions:
        """Return transitions for goals (batch, goal_size)."""
        del generator
        if self.most_steps == 1:
            return self.single(starts, goal)

        def reward_after(achieved: Array32, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
            goals = achieved.astype(np.float64), goal[chosen].astype(np.float64)
            return np.asarray(self.compute_reward(*goals))

        return self.several(starts, steps, goal, reward_after)

    def single(self, starts: Starts, goal: Array32) -> Transitions:
        """Return transitions of one step; faster than `several`."""
        episodes, row, tick = starts.episodes, starts.row, starts.tick
        state = row * (episodes.ticks + 1) + tick
        observation = flat(episodes.observation)
        achieved = flat(episodes.achieved_goal).take(state + 1, axis=0)
        reward = self.compute_reward(achieved.astype(np.float64), goal.astype(np.float64))
        return Transitions(
            observation=observation.take(state, axis=0),
            next_observation=observation.take(state + 1, axis=0),
            goal=goal,
            action=flat(episodes.action).take(row * episodes.ticks + tick, axis=0),
            reward=np.asarray(reward * self.reward_scale, dtype=np.float32),
            discount=np.full(len(row), self.gamma, np.float32),
        )

    def several(
        self, starts: Starts, steps: NDArray[np.int64], goal: Array32, reward_after: RewardAfter
    ) -> Transitions:
        """Return transitions of several steps, with the discounted sums of their rewards."""
        episodes, row, tick = starts.episodes, starts.row, starts.tick
        total = np.zeros(len(steps))
        for step in range(int(steps.max(initial=0))):
            chosen = np.flatnonzero(steps > step)
            achieved = episodes.achieved_goal[row[chosen], tick[chosen] + step + 1]
            total[chosen] += self.gamma**step * reward_after(achieved, chosen)
        return Transitions(
            observation=episodes.observation[row, tick],
            next_observation=episodes.observation[row, tick + steps],
            goal=goal,
            action=episodes.action[row, tick],
            reward=(total * self.reward_scale).astype(np.float32),
            discount=(self.gamma**steps).astype(np.float32),
        )


def sampler_fields(config: TrainConfig, metric: GoalMetric) -> dict[str, Any]:
    """Return the attributes of a `TransitionSampler` for a configuration.

    Raises:
        ValueError: If the configuration replaces the own reward of a third-party task.
    """
    reward_at = reward_schedule(config, metric)
    return {
        'compute_reward': reward_at(1.0),
        'gamma': config.tick_gamma,
        'most_steps': config.n_step,
        'reward_scale': config.tick_share,
        'lost_value': config.lowest_value if config.drop_is_lost else None,
        'reward_at': reward_at if config.narrows else None,
    }


def _with_losses(
    starts: Starts, steps: NDArray[np.int64], batch: Transitions, value: float
) -> Transitions:
    """Return the batch; transitions into the last valid state end with `value`."""
    lost = (starts.tick + steps == starts.last) & (starts.last < starts.episodes.ticks)
    reward = batch.reward + lost * batch.discount * np.float32(value)
    return replace(batch, reward=reward.astype(np.float32), discount=batch.discount * ~lost)
