"""What learners of an actor and a critic share: steps, averages, copies that act."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP, Actor
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.subgoals import Proposer
from policy_node.training.experience.transitions import Transitions
from policy_node.training.machine.distributed import Workers

# What the names of its parts begin with, in a file that has both levels.
HIGH_LEVEL = 'high_'


@dataclass(frozen=True, slots=True)
class Losses:
    """Scalars of one update, tensors on the device so that nothing waits for them."""

    critic: Tensor
    actor: Tensor
    value: Tensor


class ActorCritic:
    """What learns: an actor, its critic, and how both are improved.

    Subclasses say how an update improves them.

    Args:
        actor: The actor.
        critic: Whatever judges it.
        config: The configuration.
        device: Where they live.
        workers: With whom gradients are averaged.

    Attributes:
        actor: Holds the normalisers of all inputs.
        critic: Whatever judges it.
        average_actor: Network of the actor, averaged over cycles.
        actor_parameters: Those that learn; normalisers do not.
        critic_parameters: Those of the critic.
        updates: Updates so far.
        critic_first: The actor learns after this many of them.
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
        self.critic_first = config.learner.critic_first
        self.updates = 0

    def _adam(self, parameters: list[nn.Parameter]) -> torch.optim.Adam:
        return torch.optim.Adam(parameters, lr=self.config.learner.learning_rate, fused=True)

    def update(self, batch: Transitions) -> Losses:
        """Improves the networks on a batch."""
        raise NotImplementedError

    def step(
        self, optimizer: torch.optim.Adam, loss: Tensor, parameters: Sequence[nn.Parameter]
    ) -> None:
        """One step of an optimiser down the gradients of a loss, averaged over workers."""
        gradients = torch.autograd.grad(loss, parameters)
        self.workers.average_gradients(gradients)
        for parameter, gradient in zip(parameters, gradients, strict=True):
            parameter.grad = gradient
        optimizer.step()

    @torch.no_grad()
    def average(self) -> None:
        """Moves the averaged actor towards the actor; the trainer calls it once per cycle."""
        weight = 1.0 - self.config.learner.actor_average
        averaged: list[Tensor] = list(self.average_actor.parameters())
        torch._foreach_lerp_(averaged, [*self.actor_parameters], weight)

    def acting_actor(self) -> Actor:
        """A copy, on the CPU, of the actor that collects."""
        return self.plain(self.actor.network)

    def proposer(self, averaged: bool = False) -> Proposer | None:
        """Who gives the actor subgoals; None where nobody does. Averaged as in evaluations."""
        del averaged
        return None

    def evaluation_actor(self) -> Actor:
        """A copy, on the CPU, of the actor to evaluate: averaged weights, current normalisers."""
        return self.plain(self.average_actor)

    def plain(self, network: MLP) -> Actor:
        """A copy of the actor, on the CPU, with this network."""
        actor = copy.deepcopy(self.actor)
        actor.network.load_state_dict(network.state_dict())
        return actor.cpu().eval()

    def modules(self) -> dict[str, nn.Module]:
        """What a training state holds, by name; an actor may come without what is no actor."""
        return {'actor': self.actor, 'critic': self.critic, 'average_actor': self.average_actor}

    def optimizers(self) -> dict[str, torch.optim.Adam]:
        """The optimisers, by name, whose states a training state holds."""
        return {
            'actor_optimizer': self.actor_optimizer,
            'critic_optimizer': self.critic_optimizer,
        }

    def set_progress(self, progress: float) -> None:
        """Sets the learning rate for a run of which the share `progress` is over."""
        config, share = self.config, min(max(progress, 0.0), 1.0)
        rate = config.learner.learning_rate * (
            1.0 - share * (1.0 - config.learner.final_learning_rate)
        )
        for optimizer in (self.actor_optimizer, self.critic_optimizer):
            optimizer.param_groups[0]['lr'] = rate

    def tensor(self, values: object) -> Tensor:
        """Values of a batch where the networks are."""
        return torch.as_tensor(values).to(self.device, non_blocking=True)
