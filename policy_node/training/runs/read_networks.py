"""Read the networks that a run starts from: of another run, of an actor, or the mean of several."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.checkpoint import ActorInfo
from policy_node.policies.shipped import actor_path
from policy_node.training.configuration.config import TrainConfig, unusual_networks
from policy_node.training.configuration.flat import config_from_dict, to_flat
from policy_node.training.configuration.groups import Critics
from policy_node.training.research.registry import acting_input, network_shape, without_input
from policy_node.training.runs.initial_networks import VALUED_BY, InitialNetworks, described
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
            state of its run folder. Several names with commas: the mean of these networks.

    Raises:
        ValueError: If an actor or run is missing or damaged, or several do not fit each other.
    """
    path = Path(os.path.expanduser(name))
    if path.is_dir():
        return _of_run(path)
    if ',' in name and not path.exists():
        names = [part.strip() for part in name.split(',')]
        if not all(names):
            raise ValueError(f'init_from {name!r} has an empty name')
        return mean_of([read_initial_networks(part) for part in names])
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
    kind = config.network.goal_features, _norm(config)
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
    return (config.find(Critics) or Critics()).norm


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


# Means of networks.


def mean_of(parts: list[InitialNetworks]) -> InitialNetworks:
    """Return the mean, weight by weight, of networks that were trained from the same start.

    The mean is often better than each of them (Wortsman et al. 2022, "Model soups", arXiv
    2203.05482). Parts that only some have, such as a critic, are left out. Tasks may differ, as
    RotateZ and RotateParallel do. The mean has the task of the first.

    Raises:
        ValueError: If sizes or inputs differ, or the position counts for only some of the tasks.
    """
    first = parts[0]
    for part in parts:
        ours, theirs = _described(first), _described(part)
        differing = [
            f'{name} {value} and {theirs[name]}'
            for name, value in ours.items()
            if name in theirs and theirs[name] != value
        ]
        if (part.shape, ours['position_counts']) != (first.shape, theirs['position_counts']):
            names = f'{first.origin["name"]} and {part.origin["name"]}'
            raise ValueError(f'no mean of {names}: {"; ".join(differing)}')
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
    return replace(first, tensors=tensors, origin=_shortened(origin, set()))


def _mean(tensors: list[Tensor]) -> Tensor:
    # Counts, such as the number of normalised batches, are whole numbers.
    first = tensors[0]
    return torch.stack(tensors).mean(dim=0) if first.is_floating_point() else first


def _described(networks: InitialNetworks) -> dict[str, object]:
    """Return what must agree between the parts of a mean, by name."""
    spec = task_spec(networks.origin['task'])
    found = described(networks.shape, networks.goal_features)
    found['position_counts'] = spec.position_counts
    if networks.goal_features != 'plain':
        found['ignores_z_rotation'] = spec.ignores_z_rotation
    if networks.goal_features == 'symmetric':
        found['object_symmetry'] = spec.object_symmetry
    return found


def _shortened(origin: dict[str, Any], known: set[tuple[Any, ...]]) -> dict[str, Any]:
    """Return an origin in which repeated origins have only name, task, steps and hash."""
    key = origin.get('sha256', origin['name']), origin['env_steps']
    if key in known:
        short = ('name', 'task', 'env_steps', 'sha256')
        return {name: origin[name] for name in short if name in origin}
    known.add(key)
    result = dict(origin)
    if origin.get('init_from'):
        result['init_from'] = _shortened(origin['init_from'], known)
    if origin.get('mean_of'):
        result['mean_of'] = [_shortened(part, known) for part in origin['mean_of']]
    return result


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
