"""Rewards between sparse and dense: the better a goal is met, the more of several thresholds count.

The sparse reward says nothing of how nearly a goal was missed or how safely it was met, so an actor
holds an object no better than at the threshold, and with goals of position and rotation it forgets
what it knows of one while it never meets both.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation.rewards import GoalMetric

Values = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class GradedReward:
    """A reward from -1 to 0: the shares of thresholds met by distance and rotation, minus 1.

    Both count as their product, or, to the share `apart`, as their mean: then each is worth
    something without the other.

    Attributes:
        metric: Distances and thresholds of the task.
        grades: Multiples of its thresholds; with 1 alone the sparse reward of poses.
        apart: Share of the reward in which distance and rotation add up, 0 ... 1.
    """

    metric: GoalMetric
    grades: tuple[float, ...]
    apart: float = 0.0

    def __call__(self, achieved_goal: Values, desired_goal: Values) -> Values:
        """Rewards (...,) of goals (..., goal size)."""
        distance, rotation = self.metric.distances(achieved_goal, desired_goal)
        near = self._share(distance, self.metric.spec.distance_threshold)
        if self.metric.spec.rotation_threshold is None:
            return near - 1.0
        turned = self._share(rotation, self.metric.spec.rotation_threshold)
        return (1.0 - self.apart) * near * turned + self.apart * (near + turned) / 2.0 - 1.0

    def _share(self, error: Values, threshold: float) -> Values:
        met = [error < threshold * grade for grade in self.grades]
        return np.asarray(np.mean(met, axis=0))


def parse_grades(text: str) -> tuple[float, ...]:
    """Parses `.5,1,2` into multiples of the success thresholds.

    Raises:
        ValueError: If they are not numbers above 0, each larger than the one before.
    """
    try:
        grades = tuple(float(part) for part in text.split(','))
    except ValueError:
        grades = ()
    rising = all(low < high for low, high in pairwise((0.0, *grades, 1e3)))
    if not grades or not rising:
        raise ValueError(
            f'reward_grades {text!r}: numbers above 0 and below 1000, rising, as in .5,1,2'
        )
    return grades
