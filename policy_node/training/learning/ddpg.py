"""Deep deterministic policy gradient (Lillicrap et al. 2016) as in the paper's appendix B."""

from __future__ import annotations

import contextlib
import copy
import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.learning.config import TrainConfig
from policy_node.training.learning.distributed import Workers
from policy_node.training.learning.hindsight import Transitions


class Critic(nn.Module):
    """Action value of normalised features and an action in [-1, 1]."""

    def __init__(self, shape: NetworkShape) -> None:
        super().__init__()
        self.network = MLP(shape.feature_size + shape.action_size, 1, shape)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns values (batch,), float32."""
        value: Tensor = self.network(torch.cat([features, action], dim=-1))
        return value.squeeze(-1)


@dataclass(frozen=True, slots=True)
class Losses:
    """Scalars of one update, tensors on the device so that nothing waits for them."""

    critic: Tensor
    actor: Tensor
    value: Tensor


class DDPG:
    """Actor, critic, their targets, and one update.

    Args:
        shape: Of both networks.
        config: The configuration.
        device: Where they live.
        workers: With whom gradients are averaged.

    Attributes:
        updates: Updates so far.
        critic_first: The actor learns after this many of them.
    """

    def __init__(
        self, shape: NetworkShape, config: TrainConfig, device: torch.device, workers: Workers
    ) -> None:
        self.config = config
        self.device = device
        self._workers = workers
        self.actor = Actor(shape).to(device)
        self.critic = Critic(shape).to(device)
        self._actor_parameters = list(self.actor.network.parameters())
        self._critic_parameters = list(self.critic.parameters())
        workers.broadcast([*self._actor_parameters, *self._critic_parameters])
        self.target_actor = copy.deepcopy(self.actor.network)
        self.target_critic = copy.deepcopy(self.critic)
        self.average_actor = copy.deepcopy(self.actor.network)
        self.actor_optimizer = self._adam(self._actor_parameters)
        self.critic_optimizer = self._adam(self._critic_parameters)
        self._bfloat16 = uses_bfloat16(config.precision, device)
        self.critic_first = config.critic_first
        self.updates = 0

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learning_rate, fused=True)

    def update(self, batch: Transitions) -> Losses:
        """Improves critic and actor on a batch and, when due, moves the targets."""
        tensors = [self._tensor(getattr(batch, name)) for name in Transitions.__slots__]
        observation, next_observation, goal, action, reward = tensors
        features = self.actor.features(observation, goal)
        next_features = self.actor.features(next_observation, goal)
        critic_loss = self._update_critic(features, action, reward, next_features)
        actor_loss, value = self._update_actor(features)
        self.updates += 1
        if self.updates % self.config.target_update_interval == 0:
            self._move_targets()
        return Losses(critic_loss.detach(), actor_loss.detach(), value.detach())

    def targets(self, reward: Tensor, next_features: Tensor) -> Tensor:
        """One-step targets (batch,), clipped to the range of returns of rewards in [-1, 0].

        Episodes are cut, never terminated, so every next state is bootstrapped from.
        """
        next_action = torch.tanh(self.target_actor(next_features))
        value = self.target_critic(next_features, next_action)
        lowest = -1.0 / (1.0 - self.config.gamma)
        target: Tensor = reward + self.config.gamma * value
        return target.clamp(lowest, 0.0)

    def _update_critic(
        self, features: Tensor, action: Tensor, reward: Tensor, next_features: Tensor
    ) -> Tensor:
        with self._precision():
            with torch.no_grad():
                target = self.targets(reward, next_features)
            error: Tensor = self.critic(features, action) - target
            loss = error.square().mean()
        self._step(self.critic_optimizer, loss, self._critic_parameters)
        return loss

    def _update_actor(self, features: Tensor) -> tuple[Tensor, Tensor]:
        with self._precision():
            action = self.actor(features)
            value = self.critic(features, action).mean()
            loss = -value + self.config.action_l2 * action.float().square().mean()
        if self.updates >= self.critic_first:
            self._step(self.actor_optimizer, loss, self._actor_parameters)
        return loss, value

    def _step(
        self, optimizer: torch.optim.Adam, loss: Tensor, parameters: Sequence[nn.Parameter]
    ) -> None:
        gradients = torch.autograd.grad(loss, parameters)
        self._workers.average_gradients(gradients)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    @torch.no_grad()
    def _move_targets(self) -> None:
        weight = 1.0 - self.config.polyak
        old: list[Tensor] = [*self.target_actor.parameters(), *self.target_critic.parameters()]
        new: list[Tensor] = [*self._actor_parameters, *self._critic_parameters]
        torch._foreach_lerp_(old, new, weight)

    @torch.no_grad()
    def average(self) -> None:
        """Moves the averaged actor towards the actor; the trainer calls it once per cycle."""
        weight = 1.0 - self.config.actor_average
        averaged: list[Tensor] = list(self.average_actor.parameters())
        torch._foreach_lerp_(averaged, [*self._actor_parameters], weight)

    def evaluation_actor(self) -> Actor:
        """A copy, on the CPU, of the actor to evaluate: averaged weights, current normalisers."""
        actor = copy.deepcopy(self.actor)
        actor.network.load_state_dict(self.average_actor.state_dict())
        return actor.cpu().eval()

    def set_progress(self, progress: float) -> None:
        """Sets the learning rate for a run of which the share `progress` is over."""
        config, share = self.config, min(max(progress, 0.0), 1.0)
        rate = config.learning_rate * (1.0 - share * (1.0 - config.final_learning_rate))
        for optimizer in (self.actor_optimizer, self.critic_optimizer):
            optimizer.param_groups[0]['lr'] = rate

    def _precision(self) -> contextlib.AbstractContextManager[None]:
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16)

    def _tensor(self, values: object) -> Tensor:
        return torch.as_tensor(values).to(self.device, non_blocking=True)


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether matrix products run in bfloat16; `auto` asks the processor."""
    if precision != 'auto':
        return precision == 'bfloat16'
    if device.type == 'cuda':
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported())


def choose_device(name: str) -> torch.device:
    """Returns the device called `auto`, `cpu` or `cuda`; `auto` takes a GPU where torch sees one.

    Raises:
        ValueError: If `cuda` is asked for and torch sees none.
    """
    if name == 'cuda' and not torch.cuda.is_available():
        raise ValueError('device cuda: torch sees no GPU; allowed: auto, cpu')
    if name == 'cpu' or not torch.cuda.is_available():
        return torch.device('cpu')
    return torch.device('cuda', int(os.environ.get('LOCAL_RANK', '0')))
