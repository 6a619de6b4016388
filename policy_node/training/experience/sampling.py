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
    """Draws transitions from episodes, relabels their goals and computes their rewards.

    Attributes:
        compute_reward: Function from achieved and desired goals (..., goal_size) to rewards (...,).
        gamma: Discount per tick.
        most_steps: Longest n-step return; 1 for single transitions.
        reward_scale: Factor of all rewards.
        lost_value: Value of the last valid state of an episode that is cut because the object fell;
            None uses the value of the critic.
        reward_at: Function from the progress of the run, 0 ... 1, to `compute_reward` at that time;
            None if the reward never changes.
        sources: Functions that draw goals, by name of the goal source.
    """

    compute_reward: RewardFunction
    gamma: float
    most_steps: int = 1
    reward_scale: float = 1.0
    lost_value: float | None = None
    reward_at: Callable[[float], RewardFunction] | None = None
    sources: Mapping[str, Source] = field(default_factory=lambda: SOURCES)

    def at(self, progress: float) -> TransitionSampler:
        """Return a sampler with the reward at `progress`, the finished share 0 ... 1 of the run."""
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
        """Draw one transition for each entry of `row` and relabel its goal.

        Args:
            row: Row number of the episode for each transition, (batch,).
            mixture: Probability of each goal source; they add up to 1.
            valid_ticks: Number of valid ticks at the start of each episode, (episodes,). Only these
                are drawn. None makes all ticks valid.
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
        """Draw a goal for each transition, (batch, goal_size); `mixture` is as in `sample`."""
        source = draw_sources(mixture, len(starts.row), generator)
        return goals_of(starts, source, list(mixture), generator, self.sources)

    def steps(
        self, starts: Starts, goal: Array32, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Return the length of each n-step return in steps, (batch,).

        It is `most_steps`, or less if the valid ticks end before. Only subclasses use `goal` and
        `generator`.
        """
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
        """Return the transitions of a batch: single ones, or n-step returns of the lengths `steps`.

        `goal` is (batch, goal_size), after relabelling.
        """
        del generator
        if self.most_steps == 1:
            return self.single(starts, goal)

        def reward_after(achieved: Array32, chosen: NDArray[np.int64]) -> NDArray[np.float64]:
            goals = achieved.astype(np.float64), goal[chosen].astype(np.float64)
            return np.asarray(self.compute_reward(*goals))

        return self.several(starts, steps, goal, reward_after)

    def single(self, starts: Starts, goal: Array32) -> Transitions:
        """Return transitions of one step each, equal to `several` with `steps` of 1 but faster."""
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
        """Return n-step transitions of the lengths `steps`, (batch,), with discounted rewards.

        `reward_after(achieved, indices)` returns the rewards (n,) of achieved goals (n, goal_size).
        These are compared with the desired goals `goal[indices]`.
        """
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
    """Return keyword arguments of `TransitionSampler` for a configuration and a goal metric.

    Raises:
        ValueError: If `reward_grades` is set for a third-party task that defines its own reward.
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
    """Return `batch` with `value` in place of bootstrapping where the object has fallen.

    A fall ends the valid ticks of an episode. If a transition leads to the last valid state, the
    discounted `value` is added to its reward, and its discount becomes 0.
    """
    lost = (starts.tick + steps == starts.last) & (starts.last < starts.episodes.ticks)
    reward = batch.reward + lost * batch.discount * np.float32(value)
    return replace(batch, reward=reward.astype(np.float32), discount=batch.discount * ~lost)
