"""Proximal policy optimisation (Schulman et al. 2017, arXiv 1707.06347) for goals.

The policy is the actor with Gaussian noise of `noise_std`, clipped to the range of actions as in
the collector. The density of a clipped action is the probability of noise beyond the limit (Fujita
& Maeda 2018, arXiv 1802.07564). The normalizers include the new episodes when densities are
computed, but not when actions are drawn. From the fourth cycle on, this hardly matters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from msgs_spec.arrays import Array32
from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.actor_critic import ActorCritic, Losses
from policy_node.training.machine import Workers

# Largest change of the probability of an action in an update (the paper's value).
CLIP = 0.2
# Logarithm of the largest ratio of probabilities: the exponential of 89 is beyond float32.
LARGEST_LOG_RATIO = 20.0
_ROOT = math.sqrt(2.0 * math.pi)


@dataclass(frozen=True, slots=True, kw_only=True)
class RolloutTransitions(Transitions):
    """Transitions of the newest rollouts.

    Attributes:
        log_probability: Log density of the action, (batch,), for the actor before the first update
            on these rollouts.
        advantage: Advantage of the action, (batch,), with weighted mean 0 and deviation 1.
        value_target: Value of the state that the critic should return, (batch,).
        weight: Weight of the transition in the losses of critic and actor, (batch,).
    """

    log_probability: Array32
    advantage: Array32
    value_target: Array32
    weight: Array32


class PPO(ActorCritic):
    """Learner of proximal policy optimisation: an actor, and a critic that values states.

    Args:
        workers: Processes that train together; gradients are averaged over them.
    """

    def __init__(
        self, shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
    ) -> None:
        self._noise_std = config.noise_std
        actor, critic = Actor(shape), MLP(shape.feature_size, 1, shape)
        torch.nn.init.constant_(critic.output.bias, config.first_value)
        with torch.no_grad():
            actor.network.output.weight.mul_(config.first_action_gain)
        super().__init__(actor, critic, config, device, workers)

    def update(self, batch: Transitions) -> Losses:
        """Update critic and (after `critic_first` updates) actor once on `RolloutTransitions`."""
        assert isinstance(batch, RolloutTransitions)
        features = self.actor.features(self.tensor(batch.observation), self.tensor(batch.goal))
        weight = self.tensor(batch.weight)
        value = self.critic(features).squeeze(-1)
        critic_loss = (weight * (value - self.tensor(batch.value_target)).square()).mean()
        self.step(self.critic_optimizer, critic_loss, self.critic_parameters)
        actor_loss = self._actor_loss(batch, features, weight)
        if self.updates >= self.critic_first:
            self.step(self.actor_optimizer, actor_loss, self.actor_parameters)
        self.updates += 1
        return Losses(critic_loss.detach(), actor_loss.detach(), value.detach().mean())

    def _actor_loss(self, batch: RolloutTransitions, features: Tensor, weight: Tensor) -> Tensor:
        mean = self.actor(features)
        logs = log_probability(mean, self._noise_std, self.tensor(batch.action))
        # Beyond the bound the exponential has no gradient in float32.
        difference = logs - self.tensor(batch.log_probability)
        ratio = difference.clamp(-LARGEST_LOG_RATIO, LARGEST_LOG_RATIO).exp()
        advantage = self.tensor(batch.advantage)
        bounded = ratio.clamp(1.0 - CLIP, 1.0 + CLIP)
        gain = torch.minimum(ratio * advantage, bounded * advantage)
        cost: Tensor = self.config.action_l2 * mean.square().mean()
        return cost - (weight * gain).mean()

    @torch.no_grad()
    def values(self, observation: Array32, goal: Array32) -> Array32:
        """Return the critic's values (...,) of states (..., size) for goals (..., goal_size)."""
        features = self.actor.features(self.tensor(observation), self.tensor(goal))
        value: Array32 = self.critic(features).squeeze(-1).cpu().numpy()
        return value

    @torch.no_grad()
    def log_probabilities(self, observation: Array32, goal: Array32, action: Array32) -> Array32:
        """Return log densities (...,) of actions (..., action_size) for the actor with noise."""
        mean = self.actor(self.actor.features(self.tensor(observation), self.tensor(goal)))
        logs = log_probability(mean, self._noise_std, self.tensor(action))
        found: Array32 = logs.cpu().numpy()
        return found


def log_probability(mean: Tensor, deviation: float, action: Tensor) -> Tensor:
    """Return the log density (...,) of a noisy action that is clipped to [-1, 1].

    Args:
        mean: Action without noise, (..., action_size).
        deviation: Standard deviation of the noise.
        action: Clipped action with noise, (..., action_size).
    """
    inside = -0.5 * ((action - mean) / deviation).square() - math.log(deviation * _ROOT)
    below = torch.special.log_ndtr((-1.0 - mean) / deviation)
    above = torch.special.log_ndtr((mean - 1.0) / deviation)
    logs = torch.where(action <= -1.0, below, torch.where(action >= 1.0, above, inside))
    return logs.sum(dim=-1)
