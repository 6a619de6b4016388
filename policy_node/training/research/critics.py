"""Critics for studies: ensembles, quantiles, batch normalization and advantages."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import cast

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import Critics
from policy_node.training.learners.ddpg import (
    DDPG,
    Critic,
    CriticLoss,
    TensorBatch,
)

# Share of the running statistics that one batch replaces (CrossQ, arXiv 1902.05605: 0.01).
_MOMENTUM = 0.01
# TQC drops 2 of 25 quantiles for every critic (its table of hyperparameters, most tasks).
_DROPPED_SHARE = 2 / 25
# Names of the tensors of an `Ensemble`.
_MEMBER = re.compile(r'members\.(\d+)\.(.+)')

AGGREGATES: dict[str, Callable[[Tensor], Tensor]] = {
    'mean': lambda values: values.mean(dim=0),
    'min': lambda values: values.amin(dim=0),
    # Without the highest value, as TQC drops the highest atoms.
    'truncated': lambda values: values.sort(dim=0).values[:-1].mean(dim=0),
}
"""Functions from the values (critics, batch) of an ensemble to one value each, (batch,)."""


class Ensemble(nn.Module):
    """Two or more critics with different initial weights and the same targets."""

    def __init__(self, members: list[Critic]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Return values (critics, batch), float32."""
        return torch.stack([member(features, action) for member in self.members])

    def outputs(self, features: Tensor, action: Tensor) -> Tensor:
        """Return the outputs of all members, (critics, batch, outputs), float32."""
        members = cast(Iterable[Critic], self.members)
        return torch.stack([member.outputs(features, action) for member in members])


def members_of(tensors: dict[str, Tensor]) -> list[dict[str, Tensor]]:
    """Split the tensors of a `Critic` or `Ensemble` by critic, with the names of a `Critic`."""
    members: dict[int, dict[str, Tensor]] = {}
    for name, value in tensors.items():
        found = _MEMBER.fullmatch(name)
        index, own = (int(found[1]), found[2]) if found else (0, name)
        members.setdefault(index, {})[own] = value
    return [members[index] for index in sorted(members)]


def as_one(members: list[dict[str, Tensor]], critics: int) -> dict[str, Tensor]:
    """Merge `members` into one dictionary, the inverse of `members_of`.

    Names are those of a `Critic` if `critics`, the number of critics of the run, is 1. Otherwise
    they are those of an `Ensemble`; `members` may then be fewer than `critics`.
    """
    if critics == 1:
        return members[0]
    return {f'members.{i}.{n}': value for i, m in enumerate(members) for n, value in m.items()}


class EnsembleLoss(CriticLoss):
    """Creates one or more critics, optionally with LayerNorm; computes their squared errors."""

    def __init__(self, options: Critics) -> None:
        self.options = options

    def make(self, features: int, shape: NetworkShape) -> nn.Module:
        """Return a critic, or an `Ensemble` if the field `critics` is above 1."""
        members = [self.make_one(features, shape) for _ in range(self.options.critics)]
        return members[0] if len(members) == 1 else Ensemble(members)

    def make_one(self, features: int, shape: NetworkShape) -> Critic:
        """Return one new critic."""
        shape_here = hidden_layers(shape, self.options.norm)
        return Critic(features + shape.action_size, shape_here, self.options.quantiles)

    def pooled(self, values: Tensor) -> Tensor:
        """Combine the values (critics, batch) by the configured `aggregate`; return (batch,)."""
        return values if self.options.critics == 1 else AGGREGATES[self.options.aggregate](values)


class QuantileLoss(EnsembleLoss):
    """Quantile regression as in QR-DQN (Dabney et al. 2018, arXiv 1710.10044).

    With `aggregate=truncated`, targets leave out the highest quantiles of all critics, as in TQC
    (Kuznetsov et al. 2020, arXiv 2005.04269).
    """

    def costs(self, learner: DDPG, batch: TensorBatch) -> Tensor:
        """Return the quantile Huber loss of each transition, (batch,) or (critics, batch)."""
        critic, slow = learner.critic, learner.target_critic
        assert isinstance(critic, Critic | Ensemble) and isinstance(slow, Critic | Ensemble)
        with torch.no_grad():
            next_action = learner.target_action(batch.next_features)
            following = slow.outputs(batch.next_features, next_action)
            following = sample_of(following, self.options.aggregate == 'truncated')
            target = batch.reward[:, None] + batch.discount[:, None] * following
        quantiles = critic.outputs(batch.features, batch.action)
        return quantile_costs(quantiles, learner.clipped(target))


def sample_of(quantiles: Tensor, truncated: bool) -> Tensor:
    """Merge the quantiles of all critics into samples of the return, (batch, samples).

    Args:
        quantiles: (critics, batch, count), or (batch, count) of one critic.
        truncated: Whether to leave out the highest 8 % of the samples, at least one.
    """
    if quantiles.ndim == 2:
        quantiles = quantiles[None]
    together = quantiles.transpose(0, 1).flatten(1)
    if not truncated:
        return together
    total = together.shape[1]
    kept = total - max(round(total * _DROPPED_SHARE), 1)
    return together.sort(dim=1).values[:, :kept]


def quantile_costs(quantiles: Tensor, target: Tensor) -> Tensor:
    """Return the quantile Huber loss of each transition, (batch,) or (critics, batch).

    Args:
        quantiles: (critics, batch, count), or (batch, count) of one critic.
        target: (batch, samples), equally weighted samples of the return.
    """
    error = target.unsqueeze(-2) - quantiles.unsqueeze(-1)
    huber = nn.functional.huber_loss(error, torch.zeros_like(error), reduction='none')
    # Probabilities of the quantiles: the middles of equal shares.
    count = quantiles.shape[-1]
    level = (torch.arange(count, dtype=torch.float32, device=error.device)[:, None] + 0.5) / count
    weight = (level - (error.detach() < 0.0).float()).abs()
    cost: Tensor = (weight * huber).mean(dim=(-2, -1))
    return cost


class BatchNormLoss(EnsembleLoss):
    """Critics with batch normalization, as in CrossQ (arXiv 1902.05605).

    States and next states go through the critic in one batch. Otherwise the statistics of the
    normalization would not include the next actions.
    """

    def make_one(self, features: int, shape: NetworkShape) -> Critic:
        """Return one new critic with a batch normalization after every hidden linear layer."""
        critic = super().make_one(features, shape)
        _add_batch_norm(critic.network)
        return critic

    def errors(self, learner: DDPG, batch: TensorBatch) -> Tensor:
        """Return values minus targets, (batch,) or (critics, batch)."""
        with torch.no_grad():
            next_action = learner.target_action(batch.next_features)
        learner.critic.train()
        both = learner.critic(
            torch.cat([batch.features, batch.next_features]),
            torch.cat([batch.action, next_action]),
        )
        learner.critic.eval()
        value, next_value = both.chunk(2, dim=-1)
        target = learner.bootstrap(batch.reward, batch.discount, next_value.detach())
        error: Tensor = value - target
        return error


def _add_batch_norm(network: MLP) -> None:
    layers: list[nn.Module] = []
    for layer in network.hidden:
        layers.append(layer)
        if isinstance(layer, nn.Linear):
            layers.append(nn.BatchNorm1d(layer.out_features, momentum=_MOMENTUM))
    network.hidden = nn.Sequential(*layers)


def hidden_layers(shape: NetworkShape, norm: str) -> NetworkShape:
    """Return `shape`, with LayerNorm in the hidden layers if `norm` is `layer`."""
    return replace(shape, layer_norm=True) if norm == 'layer' else shape


def critic_loss(options: Critics) -> CriticLoss:
    """Return the critic loss that the fields of the configuration select."""
    if options.quantiles > 1:
        return QuantileLoss(options)
    return BatchNormLoss(options) if options.norm == 'batch' else EnsembleLoss(options)


class AdvantageCritic(nn.Module):
    """Two networks: the value of a state and the advantage of an action (DAU, arXiv 1901.09732).

    At a high action frequency, one action changes the return little: Q(s, a) is almost V(s), and
    the gradient of the actor vanishes. Here Q(s, a) = V(s) + dt (A(s, a) - A(s, pi(s))). The actor
    maximizes A, whose size does not depend on dt.

    Args:
        shape: Shape of the actor; both networks have the same hidden layers.
        duration: Duration dt of a tick in units of 40 ms.
    """

    def __init__(self, features: int, shape: NetworkShape, duration: float) -> None:
        super().__init__()
        self._duration = duration
        self.state_value = Critic(features, shape)
        self.advantage = Critic(features + shape.action_size, shape)

    def value(self, features: Tensor) -> Tensor:
        """Return values (batch,) of states."""
        nothing = features.new_zeros((len(features), 0))
        value: Tensor = self.state_value(features, nothing)
        return value

    def forward(self, features: Tensor, action: Tensor, own: Tensor) -> Tensor:
        """Return the values (batch,) of `action`; `own` are the actor's actions pi(s)."""
        gain: Tensor = self.advantage(features, action) - self.advantage(features, own)
        return self.value(features) + self._duration * gain


class AdvantageDDPG(DDPG):
    """Learner `DDPG` with an `AdvantageCritic` as its critic; its arguments are those of `DDPG`."""

    critic: AdvantageCritic

    def _make_networks(self, shape: NetworkShape) -> tuple[Actor, nn.Module]:
        actor = Actor(shape)
        layers = hidden_layers(shape, self.config.norm)
        return actor, AdvantageCritic(shape.feature_size, layers, self.config.tick_share)

    def _loss_of_critic(self, batch: TensorBatch) -> Tensor:
        slow = self.target_critic
        assert isinstance(slow, AdvantageCritic)
        with torch.no_grad():
            own = torch.tanh(self.actor.network(batch.features))
            value = slow.value(batch.next_features)
            target = self.bootstrap(batch.reward, batch.discount, value)
        error: Tensor = self.critic(batch.features, batch.action, own) - target
        return error.square().mean()

    def _value(self, features: Tensor, action: Tensor) -> Tensor:
        value: Tensor = self.critic.advantage(features, action).mean()
        return value
