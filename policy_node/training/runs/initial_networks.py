"""Networks that a run starts from instead of random ones: those of another run or actor."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.shipped import actor_path
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.config_rules import unusual_networks
from policy_node.training.configuration.config_values import config_from_dict
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.networks.conditions import (
    ACTING_INPUT,
    first_weights,
    with_input,
    without_input,
)
from policy_node.training.networks.critics import Ensemble, count_critics, critic_tensors
from policy_node.training.networks.network_shape import network_shape
from policy_node.training.networks.widening import can_widen, widened
from policy_node.training.runs.origins import steps_behind
from policy_node.training.runs.run_folder import STATE_FILE, companion_file
from policy_node.training.runs.training_state import part_of, read_state

# Updates of the critics alone where one starts from nothing beside an actor that is already good:
# the gradient of a critic that knows nothing would ruin it.
CRITIC_FIRST = 5_000
# Parts of a training state that are critics.
_CRITICS = ('critic', 'target_critic')
_PREFIXES = tuple(f'{part}.' for part in _CRITICS)


@dataclass(frozen=True, slots=True)
class InitialNetworks:
    """Weights and normalisers to start from.

    Attributes:
        tensors: Named as in a training state; without optimisers, counters and generators.
        shape: What they fit.
        goal_features: Their kind of inputs.
        norm: What normalises hidden layers of the critic alone.
        origin: Where they come from, for the record: name, task, environment steps and command.
    """

    tensors: dict[str, Tensor]
    shape: NetworkShape
    goal_features: str
    norm: str
    origin: dict[str, Any]

    @property
    def has_critic(self) -> bool:
        """Whether there is more than an actor."""
        return any(name.startswith('critic.') for name in self.tensors)

    def require_fit(self, config: TrainConfig) -> None:
        """Refuses networks that another run cannot start from.

        Raises:
            ValueError: One line names the sizes of both.
        """
        ours, theirs = network_shape(config), self.shape
        pairs = {
            'observation': (theirs.observation_size, ours.observation_size),
            'goal': (theirs.goal_size, ours.goal_size),
            'action': (theirs.action_size, ours.action_size),
            'hidden_sizes': (theirs.hidden_sizes, ours.hidden_sizes),
            'layer_norm': (theirs.layer_norm, ours.layer_norm),
            'goal_features': (self.goal_features, config.goal_features),
            'inputs': (theirs.feature_size, ours.feature_size),
        }
        if can_widen(theirs.hidden_sizes, ours.hidden_sizes):
            del pairs['hidden_sizes']
        differing = [f'{name} {old}, now {new}' for name, (old, new) in pairs.items() if old != new]
        if differing:
            origin = f'{self.origin["name"]} ({self.origin["task"]})'
            raise ValueError(f'{config.task} cannot start from {origin}: {"; ".join(differing)}')

    def fitted(self, config: TrainConfig) -> InitialNetworks:
        """These networks for another run, in which other inputs may begin to count.

        A critic whose hidden layers are normalised otherwise is left behind. Hidden layers may
        become wider.

        Where the position of an object did not count, the goal's position was always about the
        object's own: networks have learnt nothing from it, and what they do elsewhere is chance (an
        actor that dropped 1 block in 200 dropped half of them). So they start blind to it: its
        weights become zero. They start blind to a condition as well.

        Raises:
            ValueError: If the run cannot start from them; one line names the sizes of both.
        """
        self.require_fit(config)
        before, now, shape = task_spec(self.origin['task']), task_spec(config.task), self.shape
        fitted = self
        # The critic's inputs are the actor's, then the action.
        if shape.goal_features is not None and now.position_counts and not before.position_counts:
            inputs = shape.goal_features.goal_position(shape.observation_size, shape.goal_size)
            changed = {name: self.tensors[name].clone() for name in first_weights(self.tensors)}
            for weight in changed.values():
                weight[:, inputs] = 0.0
            fitted = replace(self, tensors=self.tensors | changed)
        if config.condition != 'none':
            tensors = with_input(fitted.tensors, shape.feature_size)
            fitted = replace(fitted, tensors=tensors)
        if config.norm != self.norm:
            fitted = fitted._without_critic()
        else:
            fitted = fitted.with_critics(config.critics)
        if config.hidden_sizes == shape.hidden_sizes:
            return fitted
        wider = replace(shape, hidden_sizes=config.hidden_sizes)
        tensors = widened(fitted.tensors, config.hidden_sizes)
        return replace(fitted, tensors=tensors, shape=wider)

    def _without_critic(self) -> InitialNetworks:
        """The actor and its normalisers alone."""
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        return replace(self, tensors=tensors, origin=self.origin | {'critic': False})

    @property
    def critics(self) -> int:
        """How many critics there are."""
        return count_critics(part_of(self.tensors, 'critic'))

    def with_critics(self, critics: int) -> InitialNetworks:
        """The same with their critics named as so many are; there may be fewer of them."""
        if critics == 1 == self.critics:
            return self
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        for part in _CRITICS:
            named = critic_tensors(part_of(self.tensors, part), critics)
            tensors |= {f'{part}.{name}': value for name, value in named.items()}
        known = {'critics': min(critics, self.critics)}
        return replace(self, tensors=tensors, origin=self.origin | known)

    def completed(self, learner: ActorCritic) -> dict[str, Tensor]:
        """The tensors, and the learner's own for critics of which there are none."""
        tensors = dict(self.tensors)
        for part, module in learner.modules().items():
            given = part_of(tensors, part)
            if given and isinstance(module, Ensemble):
                completed = module.completed(given)
                tensors |= {f'{part}.{name}': value for name, value in completed.items()}
        return tensors


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
    path = Path(name)
    if path.is_dir():
        return _of_run(path)
    if ',' in name and not path.exists():
        names = [part.strip() for part in name.split(',')]
        if not all(names):
            raise ValueError(f'init_from {name!r} has an empty name beside a comma')
        return mean_of([read_initial_networks(part) for part in names])
    return _of_actor(name, actor_path(name))


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
            raise ValueError(
                f'no mean of {first.origin["name"]} and {part.origin["name"]}: they are '
                f'{_described(first)} and {_described(part)}'
            )
    if any(part.norm != first.norm for part in parts):
        parts = [part._without_critic() for part in parts]
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


def _described(networks: InitialNetworks) -> str:
    sizes = networks.shape.hidden_sizes
    return f'{networks.origin["task"]} {sizes} {networks.goal_features}'


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
    return InitialNetworks(tensors, shape, config.goal_features, config.norm, origin)


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
    norm = 'none'
    if source is not None:
        state = read_state(source)
        if state.extra.get('actor_sha256', digest) != digest:
            raise ValueError(f'{source} is the critic of another actor than {path}')
        config = config_from_dict(state.extra['config'])
        _require_usual(config, str(source))
        norm = config.norm
        critic = _unconditioned(part_of(state.tensors, 'critic'), config)
        tensors |= {f'critic.{key}': value for key, value in critic.items()}
    origin = {
        'name': name,
        'critic': source is not None,
        'task': info.task,
        'env_steps': info.env_steps,
        'command': info.command,
        'sha256': digest,
        'init_from': info.init_from,
    }
    return InitialNetworks(tensors, info.shape, info.goal_features, norm, origin)


def _unconditioned(tensors: dict[str, Tensor], config: TrainConfig) -> dict[str, Tensor]:
    """Networks of a run as they are at the condition under which its actor acts."""
    if config.condition == 'none':
        return tensors
    column = network_shape(config).feature_size
    return without_input(tensors, column, ACTING_INPUT[config.condition])


def _sums(mean: Tensor, std: Tensor, count: int) -> dict[str, Tensor]:
    """Sums of a `RunningStatistics` that has seen `count` inputs of this mean and deviation."""
    number = torch.tensor([float(max(count, 1))], dtype=torch.float64)
    mean, std = mean.double(), std.double()
    square = (std.square() + mean.square()) * number
    return {'count': number, 'total': mean * number, 'total_square': square}
