"""Base class of all learners: an actor, its critic and their optimizers."""

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
    """Losses of critic and actor in one update, and the mean value that the critic estimates.

    The scalars stay tensors on the device of the networks, because a conversion to numbers would
    wait for the device.
    """

    critic: Tensor
    actor: Tensor
    value: Tensor


class ActorCritic:
    """Base class of learners: an actor, its critic and their optimizers.

    A subclass implements `update`. `average_actor` is a running average of the actor's weights,
    which is evaluated and saved. With `start_share`, the mean of it and `start_actor`, the actor
    from `init_from`, is evaluated and saved instead.

    Args:
        workers: Processes that train together; gradients are averaged over them.

    Attributes:
        modules: Modules to save in the training state, by name. Subclasses add theirs.
        optimizers: Optimizers to save in the training state, by name. Subclasses add theirs.
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
        self.start_actor = copy.deepcopy(self.actor.network) if config.start_share else None
        self.actor_optimizer = self._adam(self.actor_parameters)
        self.critic_optimizer = self._adam(self.critic_parameters)
        self.modules: dict[str, nn.Module] = {
            'actor': self.actor,
            'critic': self.critic,
            'average_actor': self.average_actor,
        }
        if self.start_actor is not None:
            self.modules['start_actor'] = self.start_actor
        self.optimizers = {
            'actor_optimizer': self.actor_optimizer,
            'critic_optimizer': self.critic_optimizer,
        }
        self.critic_first = config.critic_first
        self.updates = 0

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learning_rate, fused=True)

    def update(self, batch: Transitions) -> Losses:
        """Improve the networks by one gradient update on a batch; return the losses."""
        raise NotImplementedError

    def step(
        self, optimizer: torch.optim.Adam, loss: Tensor, parameters: Sequence[nn.Parameter]
    ) -> None:
        """Take one optimizer step on `parameters` with the mean gradient of `loss` over workers."""
        gradients = torch.autograd.grad(loss, parameters)
        self.workers.average_gradients(gradients)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    @torch.no_grad()
    def average(self) -> None:
        """Move `average_actor` towards the actor by the share 1 - `actor_average`, each cycle."""
        weight = 1.0 - self.config.actor_average
        averaged: list[Tensor] = list(self.average_actor.parameters())
        torch._foreach_lerp_(averaged, [*self.actor_parameters], weight)

    def acting_policy(self) -> Policy:
        """Return the policy that collects episodes: a copy of the actor on the CPU.

        The copy keeps its weights while the learner continues in another thread.
        """
        return self.plain(self.actor.network)

    @torch.no_grad()
    def evaluation_actor(self) -> Actor:
        """Return the actor to evaluate and save, on the CPU, with averaged weights."""
        actor = self.plain(self.average_actor)
        if self.start_actor is not None:
            pairs = zip(actor.network.parameters(), self.start_actor.parameters(), strict=True)
            for weight, start in pairs:
                weight.lerp_(start.cpu(), self.config.start_share)
        return actor

    def other_policies(self) -> dict[str, Policy]:
        """Return more policies to evaluate, by column of `progress.csv`; {} unless overridden."""
        return {}

    def plain(self, network: MLP) -> Actor:
        """Return an `Actor` on the CPU with the weights of `network` and the newest normalizers."""
        actor = copy.deepcopy(self.actor)
        actor.network.load_state_dict(network.state_dict())
        return actor.cpu().eval()

    def set_progress(self, progress: float) -> None:
        """Set both learning rates to those at `progress`, the finished share of the run."""
        for optimizer in (self.actor_optimizer, self.critic_optimizer):
            set_learning_rate(optimizer, self.config, progress)

    def tensor(self, values: object) -> Tensor:
        """Return an array of a batch as a tensor on the device of the networks."""
        return torch.as_tensor(values).to(self.device, non_blocking=True)


def set_learning_rate(optimizer: torch.optim.Adam, config: TrainConfig, progress: float) -> None:
    """Set the learning rate for `progress`, the finished share of the run (clipped to 0 ... 1)."""
    share = min(max(progress, 0.0), 1.0)
    rate = config.learning_rate * (1.0 - share * (1.0 - config.final_learning_rate))
    optimizer.param_groups[0]['lr'] = rate


def extra_actions(config: TrainConfig) -> int:
    """Return 1 if the actor also outputs how long its action is held, else 0."""
    return int(config.longest_hold > 1)


def network_shape(config: TrainConfig) -> NetworkShape:
    """Return the sizes and inputs of actor and critic that the configuration selects."""
    spec = task_spec(config.task)
    return NetworkShape(
        observation_size=spec.observation_size,
        goal_size=spec.goal.size,
        action_size=spec.robot.action_size + extra_actions(config),
        hidden_sizes=config.hidden_sizes,
        layer_norm=config.layer_norm,
        goal_features=goal_features(config.goal_features, spec),
        past_actions=config.past_actions,
    )


def with_inputs(tensors: dict[str, Tensor], column: int, count: int) -> dict[str, Tensor]:
    """Insert `count` inputs at index `column` into the first layers of saved networks.

    `tensors` contains the weights by parameter name. The new weights are zero, so outputs do not
    change.
    """
    changed = {}
    for name in first_weights(tensors):
        weight = tensors[name]
        zeros = weight.new_zeros((len(weight), count))
        changed[name] = torch.cat([weight[:, :column], zeros, weight[:, column:]], dim=1)
    return tensors | changed


def first_weights(tensors: dict[str, Tensor]) -> list[str]:
    """Return the names of the weights in `tensors` that multiply network inputs."""
    return [name for name in tensors if name.endswith('hidden.0.weight')]
