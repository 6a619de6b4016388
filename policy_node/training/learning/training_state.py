"""Everything a run needs to go on, in one safetensors file. The replay is refilled instead."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from policy_node.policies.checkpoint import read_tensors, write_tensors
from policy_node.training.learning.ddpg import DDPG
from policy_node.training.learning.normalizer import RunningStatistics

FORMAT = 'fetch_hand_training'
FORMAT_VERSION = 1


@dataclass(slots=True)
class Counters:
    """How far a run is.

    Attributes:
        env_steps: Environment steps of all workers.
        episodes: Episodes of all workers.
        updates: Gradient updates.
        seconds: Time spent, over all parts of a resumed run.
        best_success: Best evaluated success so far; -1 before the first evaluation.
        best_return: Mean return of that evaluation.
    """

    env_steps: int = 0
    episodes: int = 0
    updates: int = 0
    seconds: float = 0.0
    best_success: float = -1.0
    best_return: float = -1e9


def save_state(
    path: Path,
    learner: DDPG,
    statistics: dict[str, RunningStatistics],
    counters: Counters,
    extra: dict[str, Any],
) -> None:
    """Writes networks, optimisers, normalisers, counters and generators.

    Args:
        path: File to write.
        learner: The learner.
        statistics: The normalisers by name.
        counters: How far the run is.
        extra: JSON values to give back on load: configuration and generator states.
    """
    tensors: dict[str, Tensor] = {'torch_generator': torch.get_rng_state()}
    for part, module in _modules(learner).items():
        for name, value in module.state_dict().items():
            tensors[f'{part}.{name}'] = value.detach().cpu()
    for part, optimizer in _optimizers(learner).items():
        for index, state in optimizer.state_dict()['state'].items():
            for name, value in state.items():
                tensors[f'{part}.{index}.{name}'] = value.detach().cpu()
    for part, running in statistics.items():
        for name, value in running.state().items():
            tensors[f'{part}.{name}'] = value
    values = {name: getattr(counters, name) for name in Counters.__slots__}
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    metadata |= {'counters': json.dumps(values), 'extra': json.dumps(extra)}
    write_tensors(path, tensors, metadata)


def read_extra(path: Path) -> dict[str, Any]:
    """Reads the `extra` values of a training state.

    Raises:
        ValueError: If the file is no training state of this version.
    """
    _, metadata = _read(path)
    return dict(json.loads(metadata['extra']))


def load_state(path: Path, learner: DDPG, statistics: dict[str, RunningStatistics]) -> Counters:
    """Fills learner and normalisers from a file and returns how far the run was.

    Raises:
        ValueError: If the file is no training state or its tensors do not fit.
    """
    tensors, metadata = _read(path)
    if not _part(tensors, 'average_actor'):
        # States from before there was an average start it at the actor.
        network = _part(_part(tensors, 'actor'), 'network')
        tensors |= {f'average_actor.{name}': value for name, value in network.items()}
    torch.set_rng_state(tensors.pop('torch_generator'))
    try:
        for part, module in _modules(learner).items():
            module.load_state_dict(_part(tensors, part))
        for part, optimizer in _optimizers(learner).items():
            _load_optimizer(optimizer, _part(tensors, part))
        for part, running in statistics.items():
            running.load_state(_part(tensors, part))
    except (RuntimeError, KeyError) as error:
        reason = str(error).splitlines()[0]
        raise ValueError(f'{path} does not fit this configuration: {reason}') from None
    counters = Counters(**json.loads(metadata['counters']))
    learner.updates = counters.updates
    return counters


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    tensors, metadata = read_tensors(path)
    found = (metadata.get('format'), metadata.get('format_version'))
    if found != (FORMAT, str(FORMAT_VERSION)):
        raise ValueError(f'{path} is no training state of version {FORMAT_VERSION}: {found}')
    return tensors, metadata


def _modules(learner: DDPG) -> dict[str, torch.nn.Module]:
    return {
        'actor': learner.actor,
        'critic': learner.critic,
        'target_actor': learner.target_actor,
        'target_critic': learner.target_critic,
        'average_actor': learner.average_actor,
    }


def _optimizers(learner: DDPG) -> dict[str, torch.optim.Adam]:
    return {
        'actor_optimizer': learner.actor_optimizer,
        'critic_optimizer': learner.critic_optimizer,
    }


def _part(tensors: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    prefix = f'{part}.'
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def _load_optimizer(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split('.')
        state.setdefault(int(index), {})[name] = value
    groups = optimizer.state_dict()['param_groups']
    optimizer.load_state_dict({'state': state, 'param_groups': groups})
