"""Rewards between sparse and dense: the better a goal is met, the more of several thresholds count.

The sparse reward says nothing of how nearly a goal was missed or how safely it was met, so an actor
holds an object no better than at the threshold, and with goals of position and rotation it forgets
what it knows of one while it never meets both.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GradedReward:
    """A reward from -1 to 0: the shares of thresholds met by distance and rotation, minus 1.

    Attributes:
        metric: Distances and thresholds of the task.
        grades: Multiples of its thresholds; with 1 alone the sparse reward of poses.
    """

    metric: GoalMetric
    grades: tuple[float, ...]

    def __call__(self, achieved_goal: Values, desired_goal: Values) -> Values:
        """Rewards (...,) of goals (..., goal size)."""
        distance, rotation = self.metric.distances(achieved_goal, desired_goal)
        near = self._share(distance, self.metric.spec.distance_threshold)
        if self.metric.spec.rotation_threshold is None:
            return near - 1.0
        turned = self._share(rotation, self.metric.spec.rotation_threshold)
        return near * turned - 1.0

    def _share(self, error: Values, threshold: float) -> Values:
        met = [error < threshold * grade for grade in self.grades]
        return np.asarray(np.mean(met, axis=0))
