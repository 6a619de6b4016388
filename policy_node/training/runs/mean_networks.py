"""The mean of networks that were trained on from the same ones."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.training.runs.initial_networks import InitialNetworks, described


def mean_of(parts: list[InitialNetworks]) -> InitialNetworks:
    """The mean of networks that were trained on from the same ones, each weight for itself.

    Such a mean is often better than any of them (Wortsman et al. 2022, "Model soups", arXiv
    2203.05482). What only some have, as a critic, it has not. Tasks may differ, as RotateZ and
    RotateParallel do; the first is that of the mean.

    Raises:
        ValueError: If they are of different sizes or inputs, or position counts for some alone.
    """
    first = parts[0]
    for part in parts:
        if _kind(part) != _kind(first):
            names = f'{first.origin["name"]} and {part.origin["name"]}'
            raise ValueError(f'no mean of {names}: {"; ".join(_differing(first, part))}')
    kinds = [(part.norm, part.valued_by) for part in parts]
    if any(kind != kinds[0] for kind in kinds):
        parts = [part.without_critic() for part in parts]
    most = max(1, *(part.critics for part in parts))
    first, *_ = parts = [part.with_critics(most) for part in parts]
    shared = set.intersection(*(set(part.tensors) for part in parts))
    tensors = {
        name: _mean([part.tensors[name] for part in parts])
        for name in first.tensors
        if name in shared
    }
    origin = {
        'name': ','.join(part.origin['name'] for part in parts),
        'critic': any(name.startswith('critic.') for name in tensors),
        'task': first.origin['task'],
        'env_steps': 0,
        'command': '',
        'mean_of': [part.origin for part in parts],
    }
    return replace(first, tensors=tensors, origin=_said_once(origin, set()))


def _mean(tensors: list[Tensor]) -> Tensor:
    """Their mean; of counts, such as how many batches were normalised, the first."""
    first = tensors[0]
    return torch.stack(tensors).mean(dim=0) if first.is_floating_point() else first


def _said_once(origin: dict[str, Any], said: set[tuple[Any, ...]]) -> dict[str, Any]:
    """An origin in which what several parts came from is told in full the first time alone."""
    key = origin.get('sha256', origin['name']), origin['env_steps']
    if key in said:
        short = ('name', 'task', 'env_steps', 'sha256')
        return {name: origin[name] for name in short if name in origin}
    said.add(key)
    before, parts = origin.get('init_from'), origin.get('mean_of')
    told = dict(origin)
    if before:
        told['init_from'] = _said_once(before, said)
    if parts:
        told['mean_of'] = [_said_once(part, said) for part in parts]
    return told


def _kind(networks: InitialNetworks) -> tuple[object, ...]:
    counts = task_spec(networks.origin['task']).position_counts
    return networks.shape, networks.goal_features, counts


def _differing(first: InitialNetworks, other: InitialNetworks) -> list[str]:
    """What of their kinds differs, in words."""
    ours, theirs = _described(first), _described(other)
    both = [name for name in ours if name in theirs]
    return [
        f'{name} {ours[name]} and {theirs[name]}' for name in both if ours[name] != theirs[name]
    ]


def _described(networks: InitialNetworks) -> dict[str, object]:
    spec = task_spec(networks.origin['task'])
    found = described(networks.shape, networks.goal_features)
    found['position_counts'] = spec.position_counts
    if networks.goal_features != 'plain':
        found['ignores_z_rotation'] = spec.ignores_z_rotation
    if networks.goal_features == 'symmetric':
        found['object_symmetry'] = spec.object_symmetry
    return found
