"""Reads the networks that a run starts from: those of another run or of an actor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from policy_node.policies import checkpoint
from policy_node.policies.checkpoint import ActorInfo
from policy_node.policies.shipped import actor_path
from policy_node.training.configuration.config import TrainConfig, unusual_networks
from policy_node.training.configuration.flat import config_from_dict, to_flat
from policy_node.training.configuration.groups import Critics
from policy_node.training.experience.conditions import acting_input, without_input
from policy_node.training.learners.network_shape import network_shape
from policy_node.training.runs.initial_networks import VALUED_BY, InitialNetworks
from policy_node.training.runs.mean_networks import mean_of
from policy_node.training.runs.origins import steps_behind
from policy_node.training.runs.run_folder import STATE_FILE, companion_file
from policy_node.training.runs.training_state import part_of, read_state

# What an actor and the critic beside it have in common.
_SHARED = ('task', 'hidden_sizes', 'layer_norm', 'goal_features')


def read_initial_networks(name: str) -> InitialNetworks:
    """Reads the networks called `name`.

    Args:
        name: A run folder, whose latest networks are meant; a shipped actor; or the file of an
            actor. The critic of an actor lies beside it (`<Task>.training.safetensors`), or in the
            training state of the run folder that holds the file; without either it is missing.
            Several with commas between them: their mean.

    Raises:
        ValueError: If there is no such actor or run, a file is damaged, or several do not fit.
    """
    path = Path(os.path.expanduser(name))
    if path.is_dir():
        return _of_run(path)
    if ',' in name and not path.exists():
        names = [part.strip() for part in name.split(',')]
        if not all(names):
            raise ValueError(f'init_from {name!r} has an empty name beside a comma')
        return mean_of([read_initial_networks(part) for part in names])
    return _of_actor(name, actor_path(name))


def _of_run(folder: Path) -> InitialNetworks:
    state = read_state(folder / STATE_FILE)
    config = config_from_dict(state.extra['config'])
    _require_usual(config, str(folder))
    kept = ('actor', 'critic', 'target_', 'average_actor', 'observation_stat', 'goal_stat')
    tensors = {
        key: value
        for key, value in state.tensors.items()
        if key.startswith(kept) and '_optimizer.' not in key
    }
    tensors = _unconditioned(tensors, config)
    origin = {
        'name': str(folder),
        'task': config.task,
        'env_steps': state.counters.env_steps,
        'command': state.extra.get('command', ''),
        'init_from': state.extra.get('init_from', {}),
    }
    shape = network_shape(config)
    kind = config.network.goal_features, _norm(config)
    return InitialNetworks(tensors, shape, *kind, origin, _valued_by(config))


def _require_usual(config: TrainConfig, name: str) -> None:
    """Refuses networks of a run that no other run has the like of."""
    if found := unusual_networks(config):
        raise ValueError(f'{name} cannot be started from: {", ".join(found)}')


def _of_actor(name: str, path: Path) -> InitialNetworks:
    actor, info = checkpoint.load(path)
    tensors = {f'actor.{key}': value for key, value in actor.state_dict().items()}
    # A mean of several has next to no steps of its own.
    seen = steps_behind({'env_steps': info.env_steps, 'init_from': info.init_from})
    for part in ('observation', 'goal'):
        mean, std = (tensors[f'actor.{part}_normalizer.{key}'] for key in ('mean', 'std'))
        for key, value in _sums(mean, std, seen).items():
            tensors[f'{part}_statistics.{key}'] = value
    beside = (companion_file(path), path.parent / STATE_FILE)
    source = next((file for file in beside if file.is_file()), None)
    digest = checkpoint.checkpoint_hash(path)
    norm, valued_by = 'none', {}
    if source is not None:
        critic, config = _critic_beside(source, path, info, digest)
        norm, valued_by = _norm(config), _valued_by(config)
        tensors |= critic
    origin = {
        'name': name,
        'critic': source is not None,
        'task': info.task,
        'env_steps': info.env_steps,
        'command': info.command,
        'sha256': digest,
        'init_from': info.init_from,
    }
    return InitialNetworks(tensors, info.shape, info.goal_features, norm, origin, valued_by)


def _critic_beside(
    source: Path, path: Path, info: ActorInfo, digest: str
) -> tuple[dict[str, Tensor], TrainConfig]:
    """Return the critic in a training state and the configuration that trained it.

    Raises:
        ValueError: If it is the critic of another actor, or no other run can start from it.
    """
    state = read_state(source)
    if state.extra.get('actor_sha256', digest) != digest:
        raise ValueError(f'{source} is the critic of another actor than {path}')
    config = config_from_dict(state.extra['config'])
    _require_usual(config, str(source))
    _require_critic_of(info, path, config, source)
    critic = _unconditioned(part_of(state.tensors, 'critic'), config)
    return {f'critic.{key}': value for key, value in critic.items()}, config


def _require_critic_of(info: ActorInfo, path: Path, config: TrainConfig, source: Path) -> None:
    """Refuses a critic that was not trained with the actor it lies beside."""
    for name in _SHARED:
        of_actor, of_critic = getattr(info, name), to_flat(config)[name]
        if of_actor != of_critic:
            raise ValueError(
                f'{source} is the critic of another actor than {path}: '
                f'{name} {of_critic}, not {of_actor}'
            )


def _valued_by(config: TrainConfig) -> dict[str, Any]:
    return {name: to_flat(config)[name] for name in VALUED_BY}


def _norm(config: TrainConfig) -> str:
    return (config.find(Critics) or Critics()).norm


def _unconditioned(tensors: dict[str, Tensor], config: TrainConfig) -> dict[str, Tensor]:
    """Networks of a run as they are at the condition under which its actor acts."""
    value = acting_input(config)
    if value is None:
        return tensors
    column = network_shape(config).feature_size
    return without_input(tensors, column, value)


def _sums(mean: Tensor, std: Tensor, count: int) -> dict[str, Tensor]:
    """Sums of a `RunningStatistics` that has seen `count` inputs of this mean and deviation."""
    number = torch.tensor([float(max(count, 1))], dtype=torch.float64)
    mean, std = mean.double(), std.double()
    square = (std.square() + mean.square()) * number
    return {'count': number, 'total': mean * number, 'total_square': square}
