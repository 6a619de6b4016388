"""Critics: one or an ensemble, their normalisation, and what an ensemble says as one."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape

# Share of the running statistics that one batch replaces (CrossQ, arXiv 1902.05605: 0.01).
_MOMENTUM = 0.01

Aggregate = Callable[[Tensor], Tensor]


def _truncated(values: Tensor) -> Tensor:
    """Mean without the highest value, as TQC drops the highest atoms (arXiv 2005.04269)."""
    return values.sort(dim=0).values[:-1].mean(dim=0)


AGGREGATES: dict[str, Aggregate] = {
    'mean': lambda values: values.mean(dim=0),
    'min': lambda values: values.amin(dim=0),
    'truncated': _truncated,
}
"""Values (critics, batch) of an ensemble as one, (batch,)."""


class Critic(nn.Module):
    """Action value of normalised features and an action in [-1, 1].

    Args:
        inputs: Length of features and action together.
        shape: Its hidden layers.
        norm: What normalises them: `none`, `layer` or `batch`.
    """

    def __init__(self, inputs: int, shape: NetworkShape, norm: str = 'none') -> None:
        super().__init__()
        layers = replace(shape, layer_norm=True) if norm == 'layer' else shape
        self.network = MLP(inputs, 1, layers)
        if norm == 'batch':
            _add_batch_norm(self.network)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns values (batch,), float32."""
        value: Tensor = self.network(torch.cat([features, action], dim=-1))
        return value.squeeze(-1)


class Ensemble(nn.Module):
    """Critics that start differently and learn the same.

    Args:
        members: The critics, two or more.
    """

    def __init__(self, members: list[Critic]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns values (critics, batch), float32."""
        return torch.stack([member(features, action) for member in self.members])


def make_critic(inputs: int, shape: NetworkShape, norm: str, count: int) -> nn.Module:
    """Returns a critic, or an ensemble of `count` with a leading axis in its values."""
    if count == 1:
        return Critic(inputs, shape, norm)
    return Ensemble([Critic(inputs, shape, norm) for _ in range(count)])


def _add_batch_norm(network: MLP) -> None:
    """Puts a batch normalisation after every hidden linear layer."""
    layers: list[nn.Module] = []
    for layer in network.hidden:
        layers.append(layer)
        if isinstance(layer, nn.Linear):
            layers.append(nn.BatchNorm1d(layer.out_features, momentum=_MOMENTUM))
    network.hidden = nn.Sequential(*layers)
