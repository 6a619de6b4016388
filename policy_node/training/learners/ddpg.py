"""Deep deterministic policy gradient (Lillicrap et al. 2016) as in the paper's appendix B."""

from __future__ import annotations

import contextlib
import copy
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.actor_critic import ActorCritic, Losses
from policy_node.training.machine import Workers, uses_bfloat16


@dataclass(frozen=True, slots=True)
class TensorBatch:
    """The arrays of `Transitions` as tensors on the device of the networks.

    `features` are the network inputs made from `observation` and `goal`, and `next_features` those
    made from `next_observation` and `goal`.
    """

    observation: Tensor
    next_observation: Tensor
    goal: Tensor
    features: Tensor
    next_features: Tensor
    action: Tensor
    reward: Tensor
    discount: Tensor


class Critic(nn.Module):
    """Network that returns the action value of features and an action in [-1, 1].

    Args:
        inputs: Number of features plus action size.
        shape: Shape of the actor; the critic has the same hidden layers.
        outputs: Number of outputs, whose mean is the value.
    """

    def __init__(self, inputs: int, shape: NetworkShape, outputs: int = 1) -> None:
        super().__init__()
        self.network = MLP(inputs, outputs, shape)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return action values (batch,), float32: the mean of the outputs."""
        values = self.outputs(features, action)
        return values.squeeze(-1) if values.shape[-1] == 1 else values.mean(dim=-1)

    def outputs(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the outputs of the network, (batch, outputs), float32."""
        values: Tensor = self.network(torch.cat([features, action], dim=-1))
        return values


class CriticLoss:
    """Creates one critic and computes its squared errors.

    Studies replace this class by those in `research/critics.py`.
    """

    def make(self, features: int, shape: NetworkShape) -> nn.Module:
        """Return a new critic for `features` network inputs."""
        return Critic(features + shape.action_size, shape)

    def costs(self, learner: DDPG, batch: TensorBatch) -> Tensor:
        """Return the squared errors, (batch,), or (critics, batch) of an ensemble."""
        return self.errors(learner, batch).square()

    def errors(self, learner: DDPG, batch: TensorBatch) -> Tensor:
        """Return the values minus their targets, (batch,), or (critics, batch) of an ensemble."""
        with torch.no_grad():
            target = learner.targets(batch.reward, batch.discount, batch.next_features)
        error: Tensor = learner.critic(batch.features, batch.action) - target
        return error

    def pooled(self, values: Tensor) -> Tensor:
        """Return `values` (batch,) of the one critic unchanged; subclasses pool several critics."""
        return values


class DDPG(ActorCritic):
    """Learner of deep deterministic policy gradient.

    With `target=none` in the configuration, the target networks are the networks themselves.

    Args:
        workers: Processes that train together; gradients are averaged over them.
        critic_loss: Creates the critic and computes its loss. None uses `CriticLoss`, that of the
            paper.
    """

    def __init__(
        self,
        shape: NetworkShape,
        config: TrainConfig,
        device: torch.device,
        workers: Workers,
        critic_loss: CriticLoss | None = None,
    ) -> None:
        self.config = config
        self.critic_loss = critic_loss or CriticLoss()
        actor, critic = self._make_networks(shape)
        # A batch normalization updates its statistics only in the update of the critic.
        super().__init__(actor, critic.eval(), config, device, workers)
        self.target_actor, self.target_critic = self.actor.network, self.critic
        self._has_targets = config.target == 'polyak'
        if self._has_targets:
            self.target_actor = copy.deepcopy(self.target_actor)
            self.target_critic = copy.deepcopy(self.target_critic)
            self.modules['target_actor'] = self.target_actor
            self.modules['target_critic'] = self.target_critic
        self._bfloat16 = uses_bfloat16(config.precision, device)
        # Loss and value of the last update of the actor.
        self._of_actor = (torch.zeros((), device=device),) * 2
        self._set_up(shape)

    def _set_up(self, shape: NetworkShape) -> None:
        """Hook at the end of `__init__`, where subclasses create additional networks."""

    def _make_networks(self, shape: NetworkShape) -> tuple[Actor, nn.Module]:
        return Actor(shape), self.critic_loss.make(shape.feature_size, shape)

    def update(self, batch: Transitions) -> Losses:
        """Update the critic; update the actor and the target networks at their intervals.

        The intervals are `policy_delay` and `target_update_interval`. The returned loss and value
        of the actor come from its last update.
        """
        tensors = self.tensors(batch)
        critic_loss = self._update_critic(tensors)
        if self.updates % self.config.policy_delay == 0:
            self._of_actor = self._update_actor(tensors)
        self.updates += 1
        if self._has_targets and self.updates % self.config.target_update_interval == 0:
            self._move_targets()
        return Losses(critic_loss, *self._of_actor)

    @torch.no_grad()
    def _move_targets(self) -> None:
        """Move the target networks towards the learning networks by the share 1 - `polyak`."""
        weight = 1.0 - self.config.polyak
        old: list[Tensor] = [*self.target_actor.parameters(), *self.target_critic.parameters()]
        new: list[Tensor] = [*self.actor_parameters, *self.critic_parameters]
        torch._foreach_lerp_(old, new, weight)

    def tensors(self, batch: Transitions) -> TensorBatch:
        """Convert a batch to tensors; compute network inputs before and after each transition."""
        values = {name: self.tensor(getattr(batch, name)) for name in Transitions.__slots__}
        return TensorBatch(
            **values,
            features=self.actor.features(values['observation'], values['goal']),
            next_features=self.actor.features(values['next_observation'], values['goal']),
        )

    def targets(self, reward: Tensor, discount: Tensor, next_features: Tensor) -> Tensor:
        """Return the targets of the critic, (batch,), from the target networks."""
        next_action = self.target_action(next_features)
        return self.bootstrap(reward, discount, self.target_critic(next_features, next_action))

    def target_action(self, next_features: Tensor) -> Tensor:
        """Return the actions (batch, action_size) of the target actor, in [-1, 1]."""
        return torch.tanh(self.target_actor(next_features))

    def bootstrap(self, reward: Tensor, discount: Tensor, next_value: Tensor) -> Tensor:
        """Return targets (batch,): reward + discount * next value, clipped.

        Episodes are cut by time, not terminated, so the value of the last state counts too.
        """
        return self.clipped(reward + discount * self.critic_loss.pooled(next_value))

    def clipped(self, target: Tensor) -> Tensor:
        """Return targets clipped to the possible returns, `config.lowest_value` ... 0."""
        return target.clamp(self.config.lowest_value, 0.0)

    def _update_critic(self, batch: TensorBatch) -> Tensor:
        with self.precision():
            loss = self._loss_of_critic(batch)
        self.step(self.critic_optimizer, loss, self.critic_parameters)
        return loss.detach()

    def _loss_of_critic(self, batch: TensorBatch) -> Tensor:
        return self.critic_loss.costs(self, batch).mean()

    def _update_actor(self, batch: TensorBatch) -> tuple[Tensor, Tensor]:
        with self.precision():
            action = self.actor(batch.features)
            value = self._value(batch.features, action)
            loss = -value + self._penalty(batch, action)
        if self.updates >= self.critic_first:
            self.step(self.actor_optimizer, loss, self.actor_parameters)
        return loss.detach(), value.detach()

    def _value(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the mean value of the actor's `action`, a scalar that the actor maximizes."""
        value: Tensor = self.critic(features, action).mean()
        return value

    def _penalty(self, batch: TensorBatch, action: Tensor) -> Tensor:
        """Return the penalty in the actor's loss: the mean squared action times `action_l2`."""
        del batch
        cost: Tensor = self.config.action_l2 * action.float().square().mean()
        return cost

    def precision(self) -> contextlib.AbstractContextManager[None]:
        """Return a context in which matrix products use bfloat16, if `precision` selects it."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self._bfloat16)
