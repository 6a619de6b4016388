"""Networks with a condition as additional input: the success threshold or the steps left.

Each transition of a batch gets a random condition, as it gets a random goal in hindsight. The actor
always acts with the same condition. So the saved actor has the usual inputs: the constant condition
becomes part of the bias of the first layer.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array32
from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.replay import Starts, Transitions
from policy_node.training.experience.rewards import own_reward
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.learners.actor_critic import first_weights
from policy_node.training.learners.ddpg import DDPG, TensorBatch

Goals = NDArray[np.float64]
# Smallest threshold drawn, as a share of the threshold of training.
SMALLEST_THRESHOLD = 0.5


# Inputs at which the actor acts: the threshold of training, and a whole episode.
_ACTING = {'threshold': 0.0, 'horizon': 1.0}


def acting_input(config: TrainConfig) -> float | None:
    """Return the actor's condition, 0 for `condition` threshold and 1 for horizon; else None."""
    return _ACTING.get(config.condition)


@dataclass(frozen=True, slots=True, kw_only=True)
class ConditionedTransitions(Transitions):
    """A batch with a condition for each transition.

    Attributes:
        condition: Additional network input for `observation`, (batch, 1).
        next_condition: Additional network input for `next_observation`, (batch, 1).
    """

    condition: Array32
    next_condition: Array32


@dataclass(frozen=True, kw_only=True)
class ThresholdSampler(TransitionSampler):
    """Draws a success threshold for each transition, as a multiple of the task's threshold.

    Multiples are log-uniform from 0.5 to `widest`. Coarse goals are reached often, and their value
    may generalize to fine ones. The widest threshold should exceed the distance at the start of an
    episode.

    Raises:
        ValueError: If a third-party task defines its own reward.
    """

    metric: GoalMetric
    widest: float

    def __post_init__(self) -> None:
        if self.metric.has_own_reward:
            replaced = own_reward(self.metric)
            raise ValueError(
                f'condition threshold would replace {replaced}; allowed: none, horizon'
            )

    def transitions(
        self,
        starts: Starts,
        steps: NDArray[np.int64],
        goal: Array32,
        generator: np.random.Generator,
    ) -> ConditionedTransitions:
        """Return transitions with rewards for a drawn multiple of the success thresholds.

        The condition is the logarithm of the multiple. `steps` (batch,) are the lengths of n-step
        returns; `goal` is (batch, goal_size), after relabelling.
        """
        low, high = np.log(SMALLEST_THRESHOLD), np.log(self.widest)
        drawn = np.exp(generator.uniform(low, high, len(starts.row)))
        spec = self.metric.spec

        def reward_after(achieved: Array32, chosen: NDArray[np.int64]) -> Goals:
            goals = achieved.astype(np.float64), goal[chosen].astype(np.float64)
            distance, rotation = self.metric.distances(*goals)
            reached = distance < drawn[chosen] * spec.distance_threshold
            if spec.rotation_threshold is not None:
                reached &= rotation < drawn[chosen] * spec.rotation_threshold
            return reached.astype(np.float64) - 1.0

        batch = self.several(starts, steps, goal, reward_after)
        condition = np.log(drawn).astype(np.float32)[:, None]
        return _conditioned(batch, condition, condition)


@dataclass(frozen=True, kw_only=True)
class HorizonSampler(TransitionSampler):
    """Draws how many steps are left; critics learn the return of these (TDM, arXiv 1802.09081).

    Attributes:
        ticks: Length of an episode. The condition is the number of steps left, divided by it.
    """

    ticks: int

    def transitions(
        self,
        starts: Starts,
        steps: NDArray[np.int64],
        goal: Array32,
        generator: np.random.Generator,
    ) -> ConditionedTransitions:
        """Return transitions whose condition, the share of the episode left, is drawn uniformly.

        The discount is 0 where no step is left after the transition. Arguments are those of
        `TransitionSampler.transitions`.
        """
        left = generator.integers(1, self.ticks + 1, len(starts.row)).astype(np.float64)
        batch = super().transitions(starts, steps, goal, generator)
        batch = replace(batch, discount=batch.discount * (left > 1.0))
        conditions = (
            (each / self.ticks).astype(np.float32)[:, None] for each in (left, left - 1.0)
        )
        return _conditioned(batch, *conditions)


def _conditioned(
    batch: Transitions, condition: Array32, next_condition: Array32
) -> ConditionedTransitions:
    values = {name: getattr(batch, name) for name in Transitions.__slots__}
    return ConditionedTransitions(**values, condition=condition, next_condition=next_condition)


class ConditionedDDPG(DDPG):
    """`DDPG` with one more input of actor and critic: success threshold or number of steps left."""

    def _make_networks(self, shape: NetworkShape) -> tuple[Actor, nn.Module]:
        actor, inputs = Actor(shape), shape.feature_size + 1
        actor.network = MLP(inputs, shape.action_size, shape)
        return actor, self.critic_loss.make(inputs, shape)

    def tensors(self, batch: Transitions) -> TensorBatch:
        """Return the tensors of `DDPG`, whose features get the condition as last column."""
        assert isinstance(batch, ConditionedTransitions)
        tensors = super().tensors(batch)
        features = torch.cat([tensors.features, self.tensor(batch.condition)], dim=-1)
        next_condition = self.tensor(batch.next_condition)
        next_features = torch.cat([tensors.next_features, next_condition], dim=-1)
        return replace(tensors, features=features, next_features=next_features)

    def plain(self, network: MLP) -> Actor:
        """Return an `Actor` on the CPU that acts as `network` with the condition `acting_input`."""
        actor = copy.deepcopy(self.actor)
        actor.network = fold(network, actor.shape, _ACTING[self.config.condition])
        return actor.cpu().eval()


def fold(network: MLP, shape: NetworkShape, value: float) -> MLP:
    """Return a copy of `network` without its last input, the condition, which is fixed at `value`.

    The other inputs are those of `shape`. The constant becomes part of the first bias.
    """
    # The new random weights are replaced, so the global generator must not move.
    with torch.random.fork_rng(devices=[]):
        folded = MLP(shape.feature_size, shape.action_size, shape)
    folded.load_state_dict(without_input(network.state_dict(), shape.feature_size, value))
    return folded


def without_input(tensors: dict[str, Tensor], column: int, value: float) -> dict[str, Tensor]:
    """Return a new `state_dict` whose networks lack input `column`, which is fixed at `value`."""
    changed = {}
    for name in first_weights(tensors):
        weight, bias = tensors[name], name.removesuffix('weight') + 'bias'
        changed[name] = torch.cat([weight[:, :column], weight[:, column + 1 :]], dim=1)
        changed[bias] = tensors[bias] + value * weight[:, column]
    return tensors | changed
