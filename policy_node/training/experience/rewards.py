"""Rewards for training: those of the task, or variants with wider or several thresholds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.hindsight import RewardFunction

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GradedReward:
    """A reward between -1 and 0 that rises with the number of thresholds met.

    The reward is the share of distance thresholds met, minus 1. If the goal has a rotation, this
    share is multiplied by the share of rotation thresholds met. The sparse reward shows
    neither how nearly a goal was missed nor how safely it was met. An actor trained with the sparse
    reward holds an object no better than the threshold requires. It also neglects position or
    rotation as long as it never meets both thresholds at once.

    Attributes:
        metric: Computes distance and rotation to the goal; its task has the success thresholds.
        grades: Factors on the success thresholds; (1,) gives the sparse reward.
    """

    metric: GoalMetric
    grades: tuple[float, ...]

    def __call__(self, achieved_goal: Values, desired_goal: Values) -> Values:
        """Return rewards (...,) of goals (..., goal size)."""
        distance, rotation = self.metric.distances(achieved_goal, desired_goal)
        near = self._share(distance, self.metric.spec.distance_threshold)
        if self.metric.spec.rotation_threshold is None:
            return near - 1.0
        turned = self._share(rotation, self.metric.spec.rotation_threshold)
        return near * turned - 1.0

    def _share(self, error: Values, threshold: float) -> Values:
        met = [error < threshold * grade for grade in self.grades]
        return np.asarray(np.mean(met, axis=0))


def reward_schedule(config: TrainConfig, metric: GoalMetric) -> Callable[[float], RewardFunction]:
    """Return a function that returns the reward function at a progress of the run, 0 ... 1.

    Raises:
        ValueError: If `reward_grades` is set for a third-party task that defines its own reward.
    """
    if metric.has_own_reward and config.reward_grades:
        raise ValueError(
            f'reward_grades {config.reward_grades} would replace {own_reward(metric)}; allowed: '
            'none (--set reward_grades=)'
        )

    def reward_at(progress: float) -> RewardFunction:
        then = narrowed(metric, config, progress)
        return GradedReward(then, config.reward_grades) if config.reward_grades else then.reward

    return reward_at


def own_reward(metric: GoalMetric) -> str:
    """Return the words that name the reward of a third-party task in error messages."""
    return f'the reward of {metric.spec.name} itself ({type(metric).__name__})'


def narrowed(metric: GoalMetric, config: TrainConfig, progress: float) -> GoalMetric:
    """Return a copy of `metric` with the success thresholds at this progress of a run, 0 ... 1.

    At the start, `config.first_distance` and `config.first_rotation` multiply the thresholds. These
    factors change exponentially and reach 1 after two thirds of the run.
    """
    left = max(1.0 - 1.5 * progress, 0.0)
    distance, rotation = config.first_distance**left, config.first_rotation**left
    spec = replace(metric.spec, distance_threshold=metric.spec.distance_threshold * distance)
    if spec.rotation_threshold is not None:
        spec = replace(spec, rotation_threshold=spec.rotation_threshold * rotation)
    return metric.with_changes(spec=spec)
