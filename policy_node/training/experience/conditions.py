"""Value functions with one input more: how close is close enough, or how much time is left.

A transition is then learnt from under a value of that input drawn at random, as it is for a goal
chosen in hindsight. The actor acts at one value of it for good, so that what is saved is an actor
like any other: the input is a constant, and its column goes into the bias of the first layer.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array32
from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration import groups
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.widening import first_weights

Goals = NDArray[np.float64]
# Smallest threshold drawn, as a share of the one that is trained for.
SMALLEST_THRESHOLD = 0.5


@dataclass(frozen=True, slots=True)
class Threshold:
    """The success threshold, a multiple of the one that is trained for, log-uniform.

    That is the task's own, times `reward_distance` and `reward_rotation` of the configuration.

    From coarse goals, which are reached often, the value of fine ones can be generalised. Where the
    widest is narrower than the way that an episode begins with, nothing leads there.

    Attributes:
        metric: Distances of the task, and the thresholds that are trained for.
        widest: The largest multiple.
    """

    metric: GoalMetric
    widest: float

    def draw(self, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
        """Draws the values (count,) that transitions are learnt from under: multiples of it."""
        low, high = np.log(SMALLEST_THRESHOLD), np.log(self.widest)
        return np.asarray(np.exp(generator.uniform(low, high, count)))

    def inputs(self, drawn: NDArray[np.float64]) -> Array32:
        """What the networks see of them, (count, 1): their logarithms."""
        return np.log(drawn).astype(np.float32)[:, None]

    def reward(self, achieved: Goals, desired: Goals, drawn: NDArray[np.float64]) -> Goals:
        """Reward (count,) of goals under them: 0 within that multiple, else -1."""
        distance, rotation = self.metric.distances(achieved, desired)
        spec = self.metric.spec
        reached = distance < drawn * spec.distance_threshold
        if spec.rotation_threshold is not None:
            reached &= rotation < drawn * spec.rotation_threshold
        return reached.astype(np.float64) - 1.0

    def after(self, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
        """Their values one step later, (count,): the same."""
        return drawn

    def goes_on(self, drawn: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether anything after this step counts, (count,): always."""
        return np.ones(len(drawn), np.bool_)


@dataclass(frozen=True, slots=True)
class Horizon:
    """The number of steps left: values are rewards of that many, as in TDM (arXiv 1802.09081).

    Attributes:
        ticks: Steps of an episode, the most that can be left.
        compute_reward: (achieved_goal, desired_goal) -> reward, batched.
    """

    ticks: int
    compute_reward: Callable[[Goals, Goals], Goals]

    def draw(self, count: int, generator: np.random.Generator) -> NDArray[np.float64]:
        """Draws from 1 to the length of an episode."""
        return generator.integers(1, self.ticks + 1, count).astype(np.float64)

    def inputs(self, drawn: NDArray[np.float64]) -> Array32:
        """The share of an episode."""
        return (drawn / self.ticks).astype(np.float32)[:, None]

    def reward(self, achieved: Goals, desired: Goals, drawn: NDArray[np.float64]) -> Goals:
        """The reward (count,) of the task, whatever was drawn."""
        del drawn
        return self.compute_reward(achieved, desired)

    def after(self, drawn: NDArray[np.float64]) -> NDArray[np.float64]:
        """One less."""
        return drawn - 1.0

    def goes_on(self, drawn: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Whether a step is left after this one."""
        return drawn > 1.0


Condition = Threshold | Horizon
"""What a value is conditioned on, beside state, action and goal."""


def acting_input(config: TrainConfig) -> float | None:
    """Return the input at which an actor acts; None without a condition.

    That is the threshold that is trained for, or a whole episode left.
    """
    if config.find(groups.Threshold):
        return 0.0
    return 1.0 if config.find(groups.Horizon) else None


def make_condition(config: TrainConfig, metric: GoalMetric) -> Condition | None:
    """Return the condition of a run, or None."""
    if threshold := config.find(groups.Threshold):
        return Threshold(metric, threshold.widest_threshold)
    if config.find(groups.Horizon):
        return Horizon(metric.spec.episode_ticks, metric.reward)
    return None


def fold(network: MLP, shape: NetworkShape, value: float) -> MLP:
    """A network without its last input, which is `value` for good.

    Args:
        network: Its first layer takes `shape.feature_size` + 1 inputs.
        shape: Of the network to make.
        value: That input.
    """
    # Its random weights are thrown away: what is drawn next is as if there were none.
    with torch.random.fork_rng(devices=[]):
        folded = MLP(shape.feature_size, shape.action_size, shape)
    folded.load_state_dict(without_input(network.state_dict(), shape.feature_size, value))
    return folded


def without_input(tensors: dict[str, Tensor], column: int, value: float) -> dict[str, Tensor]:
    """Networks, by name, without the input at that column, which is `value` for good."""
    changed = {}
    for name in first_weights(tensors):
        weight, bias = tensors[name], name.removesuffix('weight') + 'bias'
        changed[name] = torch.cat([weight[:, :column], weight[:, column + 1 :]], dim=1)
        changed[bias] = tensors[bias] + value * weight[:, column]
    return tensors | changed
