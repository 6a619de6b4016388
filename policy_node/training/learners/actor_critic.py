"""An actor, its critic and their optimizers: what all learners share."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from msgs_spec.tasks import task_spec
from policy_node.policies.actor import MLP, Actor
from policy_node.policies.goal_features import goal_features
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.replay import Transitions
from policy_node.training.machine import Workers


@dataclass(frozen=True, slots=True)
class Losses:
    """Scalars of one update, as tensors on the device, so that no code waits for them."""

    critic: Tensor
    actor: Tensor
    value: Tensor


class ActorCritic:
    """An actor, its critic and their optimizers; subclasses define an update.

    Args:
        workers: This worker among all; gradients are averaged over all.
    """

    def __init__(
        self,
        actor: Actor,
        critic: nn.Module,
        config: TrainConfig,
        device: torch.device,
        workers: Workers,
    ) -> None:
        self.config = config
        self.device = device
        self.workers = workers
        self.actor = actor.to(device)
        self.critic = critic.to(device)
        self.actor_parameters = list(self.actor.network.parameters())
        self.critic_parameters = list(self.critic.parameters())
        workers.broadcast([*self.actor_parameters, *self.critic_parameters])
        self.average_actor = copy.deepcopy(self.actor.network)
        self.actor_optimizer = self._adam(self.actor_parameters)
        self.critic_optimizer = self._adam(self.critic_parameters)
        self.critic_first = config.critic_first
        self.updates = 0

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learning_rate, fused=True)

    def update(self, batch: Transitions) -> Losses:
        """Improve the networks on a batch."""
        raise NotImplementedError

    def step(
        self, optimizer: torch.optim.Adam, loss: Tensor, parameters: Sequence[nn.Parameter]
    ) -> None:
        """Take one optimizer step down the gradients of a loss, averaged over workers."""
        gradients = torch.autograd.grad(loss, parameters)
        self.workers.average_gradients(gradients)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    @torch.no_grad()
    def average(self) -> None:
        """Move the averaged actor towards the actor, once per cycle."""
        weight = 1.0 - self.config.actor_average
        averaged: list[Tensor] = list(self.average_actor.parameters())
        torch._foreach_lerp_(averaged, [*self.actor_parameters], weight)

    def acting_policy(self) -> Policy:
        """Return the policy that collects: a copy of the actor on the CPU."""
        return self.plain(self.actor.network)

    def evaluation_actor(self) -> Actor:
        """Return the actor to evaluate, on the CPU: averaged weights, current normalizers."""
        return self.plain(self.average_actor)

    def other_policies(self) -> dict[str, Policy]:
        """Return policies to evaluate beside the actor, by column of `progress.csv`."""
        return {}

    def plain(self, network: MLP) -> Actor:
        """Return a copy of the actor on the CPU with the weights of this network."""
        actor = copy.deepcopy(self.actor)
        actor.network.load_state_dict(network.state_dict())
        return actor.cpu().eval()

    def modules(self) -> dict[str, nn.Module]:
        """Return the modules that a training state contains, by name."""
        return {'actor': self.actor, 'critic': self.critic, 'average_actor': self.average_actor}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """Return the optimizers whose states a training state contains, by name."""
        return {
            'actor_optimizer': self.actor_optimizer,
            'critic_optimizer': self.critic_optimizer,
        }

    def set_progress(self, progress: float) -> None:
        """Set the learning rate for this progress of the run, 0 ... 1."""
        config, share = self.config, min(max(progress, 0.0), 1.0)
        rate = config.learning_rate * (1.0 - share * (1.0 - config.final_learning_rate))
        for optimizer in (self.actor_optimizer, self.critic_optimizer):
            optimizer.param_groups[0]['lr'] = rate

    def tensor(self, values: object) -> Tensor:
        """Return values of a batch as a tensor on the device of the networks."""
        return torch.as_tensor(values).to(self.device, non_blocking=True)


def network_shape(config: TrainConfig, extra_actions: int = 0) -> NetworkShape:
    """Return the shape of actor and critic."""
    spec = task_spec(config.task)
    return NetworkShape(
        observation_size=spec.observation_size,
        goal_size=spec.goal.size,
        action_size=spec.robot.action_size + extra_actions,
        hidden_sizes=config.hidden_sizes,
        layer_norm=config.layer_norm,
        goal_features=goal_features(config.goal_features, spec),
        past_actions=config.past_actions,
    )


def with_inputs(tensors: dict[str, Tensor], column: int, count: int) -> dict[str, Tensor]:
    """Return networks with `count` more inputs from `column` on; their weights are zero."""
    changed = {}
    for name in first_weights(tensors):
        weight = tensors[name]
        zeros = weight.new_zeros((len(weight), count))
        changed[name] = torch.cat([weight[:, :column], zeros, weight[:, column:]], dim=1)
    return tensors | changed


def first_weights(tensors: dict[str, Tensor]) -> list[str]:
    """Return the names of the weights of layers that take the inputs."""
    return [name for name in tensors if name.endswith('hidden.0.weight')]
