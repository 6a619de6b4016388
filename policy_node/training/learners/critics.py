"""Critics: one, an ensemble and what it says as one, or values and advantages apart."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor, nn

from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.groups import Advantages, Critics

# Share of the running statistics that one batch replaces (CrossQ, arXiv 1902.05605: 0.01).
_MOMENTUM = 0.01
# Where an `Ensemble` has its critics.
_MEMBERS = 'members.'

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
        outputs: Quantiles of the return that it learns; 1 is its mean.
    """

    def __init__(
        self, inputs: int, shape: NetworkShape, norm: str = 'none', outputs: int = 1
    ) -> None:
        super().__init__()
        layers = replace(shape, layer_norm=True) if norm == 'layer' else shape
        self.network = MLP(inputs, outputs, layers)
        if norm == 'batch':
            _add_batch_norm(self.network)

    def forward(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns values (batch,), float32: what a mean or quantiles say."""
        said = self.quantiles(features, action)
        return said.squeeze(-1) if said.shape[-1] == 1 else said.mean(dim=-1)

    def quantiles(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns quantiles (batch, outputs) of the return, float32."""
        said: Tensor = self.network(torch.cat([features, action], dim=-1))
        return said


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

    def quantiles(self, features: Tensor, action: Tensor) -> Tensor:
        """Returns quantiles (critics, batch, outputs) of the return, float32."""
        return torch.stack([member.quantiles(features, action) for member in self._critics()])

    def _critics(self) -> Iterator[Critic]:
        for member in self.members:
            assert isinstance(member, Critic)
            yield member

    def completed(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """These, and its own tensors for the members of which they have nothing."""
        given = {_member_of(name) for name in tensors}
        own = self.state_dict().items()
        return {name: value for name, value in own if _member_of(name) not in given} | tensors


def critic_tensors(tensors: dict[str, Tensor], critics: int) -> dict[str, Tensor]:
    """Tensors of one critic or of several, by the names they have in another number of critics.

    Args:
        tensors: As `Critic` or `Ensemble` has them.
        critics: How many there are to be; members beyond it are left out.
    """
    if not is_ensemble(tensors):
        tensors = {f'{_MEMBERS}0.{name}': value for name, value in tensors.items()}
    if critics == 1:
        first = f'{_MEMBERS}0.'
        return {n.removeprefix(first): v for n, v in tensors.items() if n.startswith(first)}
    return {name: value for name, value in tensors.items() if _member_of(name) < critics}


def is_ensemble(tensors: dict[str, Tensor]) -> bool:
    """Whether they are named as those of an `Ensemble`, of one critic perhaps."""
    return any(name.startswith(_MEMBERS) for name in tensors)


def count_critics(tensors: dict[str, Tensor]) -> int:
    """How many critics these are tensors of."""
    if not is_ensemble(tensors):
        return 1 if tensors else 0
    return len({_member_of(name) for name in tensors})


def _member_of(name: str) -> int:
    """The number of the critic that a tensor of an `Ensemble` is of."""
    return int(name.removeprefix(_MEMBERS).split('.')[0])


class AdvantageCritic(nn.Module):
    """Value of a state and advantage of an action, two networks (DAU, arXiv 1901.09732).

    The more frequent actions are, the less a single one of them matters: action values become
    values of states, and what an actor is to climb vanishes. Here Q(s, a) = V(s) + dt (A(s, a) -
    A(s, pi(s))), so that A keeps its size whatever dt is and the actor climbs A. dt is 1 for a tick
    of 40 ms.

    Args:
        features: Length of the features, a condition included.
        shape: Of the actor; hidden layers are the same.
        norm: What normalises them: `none` or `layer`.
        duration: Of a tick, in units of 40 ms.
    """

    def __init__(self, features: int, shape: NetworkShape, norm: str, duration: float) -> None:
        super().__init__()
        self._duration = duration
        self.state_value = Critic(features, shape, norm)
        self.advantage = Critic(features + shape.action_size, shape, norm)

    def value(self, features: Tensor) -> Tensor:
        """Values (batch,) of states."""
        nothing = features.new_zeros((len(features), 0))
        value: Tensor = self.state_value(features, nothing)
        return value

    def forward(self, features: Tensor, action: Tensor, own: Tensor) -> Tensor:
        """Values (batch,) of actions, of which `own` has the value of its state."""
        gain: Tensor = self.advantage(features, action) - self.advantage(features, own)
        return self.value(features) + self._duration * gain


def make_critic(config: TrainConfig, features: int, shape: NetworkShape) -> nn.Module:
    """Returns what a configuration asks for; values of an ensemble have a leading axis.

    Args:
        config: The configuration.
        features: Length of the features, a condition included.
        shape: Of the actor; hidden layers are the same.
    """
    options = config.find(Critics) or Critics()
    if config.find(Advantages):
        return AdvantageCritic(features, shape, options.norm, config.tick_share)
    inputs = features + shape.action_size
    members = [
        Critic(inputs, shape, options.norm, options.quantiles) for _ in range(options.critics)
    ]
    return members[0] if options.critics == 1 else Ensemble(members)


def _add_batch_norm(network: MLP) -> None:
    """Puts a batch normalisation after every hidden linear layer."""
    layers: list[nn.Module] = []
    for layer in network.hidden:
        layers.append(layer)
        if isinstance(layer, nn.Linear):
            layers.append(nn.BatchNorm1d(layer.out_features, momentum=_MOMENTUM))
    network.hidden = nn.Sequential(*layers)
