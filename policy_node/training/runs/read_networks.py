"""Read the networks that a run starts from: those of another run or of an actor."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from policy_node.policies import checkpoint
from policy_node.policies.checkpoint import ActorInfo
from policy_node.policies.loading import actor_path
from policy_node.training.configuration.config import TrainConfig, unusual_networks
from policy_node.training.configuration.flat import config_from_dict, to_flat
from policy_node.training.research.registry import acting_input, network_shape, without_input
from policy_node.training.runs.initial_networks import VALUED_BY, InitialNetworks
from policy_node.training.runs.run_folder import STATE_FILE, companion_file
from policy_node.training.runs.training_state import part_of, read_state

# Fields that must agree between an actor and the critic beside it.
_SHARED = ('task', 'hidden_sizes', 'layer_norm', 'goal_features')
# Parts of a training state to start from; optimisers start fresh.
_PARTS = ('actor', 'critic', 'target_', 'average_actor', 'observation_stat', 'goal_stat')


def read_initial_networks(name: str) -> InitialNetworks:
    """Read the networks called `name`.

    Args:
        name: A run folder, for its latest networks; a shipped actor; or the file of an actor. The
            critic of an actor is in `<Task>.training.safetensors` beside it, or in the training
            state of its run folder.

    Raises:
        ValueError: If the actor or run is missing or damaged.
    """
    path = Path(os.path.expanduser(name))
    if path.is_dir():
        return _of_run(path)
    return _of_actor(name, actor_path(name))


def _of_run(folder: Path) -> InitialNetworks:
    state = read_state(folder / STATE_FILE)
    config = config_from_dict(state.extra['config'])
    _require_usual(config, folder)
    tensors = {
        key: value
        for key, value in state.tensors.items()
        if key.startswith(_PARTS) and '_optimizer.' not in key
    }
    tensors = _unconditioned(tensors, config)
    origin = {
        'name': str(folder),
        'task': config.task,
        'env_steps': state.counters.env_steps,
        'command': state.extra.get('command', ''),
        'init_from': state.extra.get('init_from', {}),
    }
    kind = config.goal_features, _norm(config)
    return InitialNetworks(tensors, network_shape(config), *kind, origin, _valued_by(config))


def _of_actor(name: str, path: Path) -> InitialNetworks:
    actor, info = checkpoint.load(path)
    tensors = {f'actor.{key}': value for key, value in actor.state_dict().items()}
    # A mean of several has few steps of its own.
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
    """Return the critic in a training state and the configuration of its training.

    Raises:
        ValueError: If it belongs to another actor, or no other run can start from it.
    """
    state = read_state(source)
    config = config_from_dict(state.extra['config'])
    _require_usual(config, source)
    differing = [
        f'{name} {to_flat(config)[name]}, not {getattr(info, name)}'
        for name in _SHARED
        if to_flat(config)[name] != getattr(info, name)
    ]
    if differing or state.extra.get('actor_sha256', digest) != digest:
        reason = f': {"; ".join(differing)}' if differing else ''
        raise ValueError(f'{source} is the critic of another actor than {path}{reason}')
    critic = _unconditioned(part_of(state.tensors, 'critic'), config)
    return {f'critic.{name}': value for name, value in critic.items()}, config


def _require_usual(config: TrainConfig, source: Path) -> None:
    if found := unusual_networks(config):
        raise ValueError(f'a run cannot start from {source}: {", ".join(found)}')


def _valued_by(config: TrainConfig) -> dict[str, Any]:
    return {name: to_flat(config)[name] for name in VALUED_BY}


def _norm(config: TrainConfig) -> str:
    return config.norm


def _unconditioned(tensors: dict[str, Tensor], config: TrainConfig) -> dict[str, Tensor]:
    """Return networks without their condition input, fixed at its value for acting."""
    value = acting_input(config)
    if value is None:
        return tensors
    column = network_shape(config).feature_size
    return without_input(tensors, column, value)


def _sums(mean: Tensor, std: Tensor, count: int) -> dict[str, Tensor]:
    """Return the sums of `RunningStatistics` after `count` inputs of this mean and deviation."""
    number = torch.tensor([float(max(count, 1))], dtype=torch.float64)
    mean, std = mean.double(), std.double()
    square = (std.square() + mean.square()) * number
    return {'count': number, 'total': mean * number, 'total_square': square}


def steps_behind(run: dict[str, Any]) -> int:
    """Return the environment steps of an actor and of all networks that it started from.

    Each run counts once, with its latest actor.

    Args:
        run: `env_steps` and `init_from`, as in the JSON file of an actor.
    """
    counted: dict[object, int] = {}
    waiting = [run]
    while waiting:
        part = waiting.pop()
        steps = int(part['env_steps'])
        key = _run_of(part, steps)
        counted[key] = max(counted.get(key, 0), steps)
        waiting += [part['init_from']] if part.get('init_from') else []
        waiting += part.get('mean_of', [])
    return sum(counted.values())


def _run_of(part: dict[str, Any], steps: int) -> object:
    """Return a key that all actors of a run share: its folder, if one is named."""
    name = part.get('name', '')
    if name and ',' not in name:
        if name.endswith('.safetensors'):
            return str(Path(name).parent)
        # The name of a run folder; only actors have a hash.
        if 'sha256' not in part:
            return str(Path(name))
    return (part.get('sha256') or name, steps)
