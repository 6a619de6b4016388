"""Read the networks that a run starts from with `init_from`, and adapt them to the run."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.loading import actor_path
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig, unusual_networks
from policy_node.training.configuration.flat import config_from_dict
from policy_node.training.learners.actor_critic import (
    ActorCritic,
    first_weights,
    network_shape,
    with_inputs,
)
from policy_node.training.research.registry import (
    acting_input,
    as_one,
    members_of,
    without_input,
)
from policy_node.training.runs.run_folder import LATEST_FILE, STATE_FILE, companion_file
from policy_node.training.runs.training_state import TrainingState, part_of, read_state

# Updates of the critics alone if a random critic starts beside a trained actor: the gradient of an
# untrained critic would ruin the actor.
CRITIC_FIRST = 5_000
# If these differ, a critic has other layers, or its values another meaning: dense rewards are
# distances, and discounts are per tick.
_CRITIC_FIELDS = ('norm', 'reward_type', 'control_hz')
# Fields that must agree between an actor and the critic beside it.
_SHARED = ('task', 'hidden_sizes', 'layer_norm', 'goal_features')
# Parts of a training state to start from; optimisers start fresh.
_PARTS = ('actor', 'critic', 'target_', 'average_actor', 'observation_stat', 'goal_stat')
# Parts that are critics.
_CRITICS = ('critic', 'target_critic')
_PREFIXES = tuple(f'{part}.' for part in _CRITICS)


@dataclass(frozen=True, slots=True)
class InitialNetworks:
    """Networks and normalizer statistics that a run starts from instead of random ones.

    Attributes:
        tensors: Weights and normalizer statistics, by their names in the file `STATE_FILE`.
        shape: Sizes and inputs of the actor.
        goal_features: Value of the field `goal_features` that the networks were trained with.
        control_hz: Action frequency that the networks were trained at, Hz.
        origin: Record of their training: name, task, environment steps and command line.
        critic_config: Configuration with which the critic was trained; None without a critic.
    """

    tensors: dict[str, Tensor]
    shape: NetworkShape
    goal_features: str
    control_hz: float
    origin: dict[str, Any]
    critic_config: TrainConfig | None

    @property
    def critics(self) -> int:
        """Number of critics in `tensors`; 0 without a critic."""
        return len(members_of(part_of(self.tensors, 'critic')))

    def require_fit(self, config: TrainConfig) -> None:
        """Raise ValueError if a run with this configuration cannot start from these networks."""
        ours = _described(network_shape(config), config.goal_features)
        theirs = _described(self._shape_in(config), self.goal_features)
        differing = [
            f'{name} {old}, now {ours[name]}' for name, old in theirs.items() if old != ours[name]
        ]
        if differing:
            origin = f'{self.origin["name"]} ({self.origin["task"]})'
            raise ValueError(f'{config.task} cannot start from {origin}: {"; ".join(differing)}')

    def fitted(self, config: TrainConfig) -> InitialNetworks:
        """Return a copy adapted to a run with this configuration.

        - A critic is left out if it was trained with another `norm`, `reward_type` or
          `control_hz`. A critic with another `gamma` stays; `critic_first` lets it adapt.
        - Inputs for past actions and for the field `condition` are added with zero weights.
        - If the object's position counts only in the new task (a `Full` task after a `Rotate`
          task), the weights of the goal position become zero. In the old task this position
          equalled the object's, so the networks learnt nothing from it. With the old weights, an
          actor that dropped 1 block in 200 dropped half.

        Raises:
            ValueError: If the run cannot start from these networks.
        """
        self.require_fit(config)
        before, now = task_spec(self.origin['task']), task_spec(config.task)
        fitted = self._with_past_of(config)
        shape = fitted.shape
        # The critic has the inputs of the actor, then the action.
        if shape.goal_features is not None and now.position_counts and not before.position_counts:
            # Past actions follow the goal features.
            inputs = shape.goal_features.goal_position(shape.observation_size, shape.past_start)
            changed = {name: fitted.tensors[name].clone() for name in first_weights(fitted.tensors)}
            for weight in changed.values():
                weight[:, inputs] = 0.0
            fitted = replace(fitted, tensors=fitted.tensors | changed)
        if acting_input(config) is not None:
            tensors = with_inputs(fitted.tensors, shape.feature_size, 1)
            fitted = replace(fitted, tensors=tensors)
        critic = self.critic_config
        if critic and all(getattr(critic, n) == getattr(config, n) for n in _CRITIC_FIELDS):
            return fitted._with_critics(config.critics)
        return fitted._with_critics(0)

    def _shape_in(self, config: TrainConfig) -> NetworkShape:
        """Return `shape`; if it has no past actions, with as many as `config` has."""
        past = self.shape.past_actions or config.past_actions
        return replace(self.shape, past_actions=past)

    def _with_past_of(self, config: TrainConfig) -> InitialNetworks:
        """Return a copy with the configured past actions as inputs; `self` if nothing changes.

        The weights of these inputs start at zero; the normalizer starts at mean 0 and deviation 1.
        """
        shape = self._shape_in(config)
        if shape == self.shape:
            return self
        tensors = with_inputs(self.tensors, shape.past_start, shape.past_size)
        added = {'mean': 0.0, 'std': 1.0, 'total': 0.0}
        count = tensors.get('observation_statistics.count')
        if count is not None:
            added['total_square'] = float(count)
        for name, tensor in tensors.items():
            part, _, statistic = name.rpartition('.')
            if part.endswith(('observation_normalizer', 'observation_statistics')) and (
                statistic in added
            ):
                more = tensor.new_full((shape.past_size,), added[statistic])
                tensors[name] = torch.cat([tensor, more])
        return replace(self, tensors=tensors, shape=shape)

    def _with_critics(self, critics: int) -> InitialNetworks:
        """Return a copy with up to `critics` critics, named as in a run that has `critics` of them.

        Surplus critics are left out. Missing ones are added later, by `completed`.
        """
        tensors = {n: v for n, v in self.tensors.items() if not n.startswith(_PREFIXES)}
        if not critics:
            origin = self.origin | {'critic': False}
            return replace(self, tensors=tensors, origin=origin, critic_config=None)
        for part in _CRITICS:
            if members := members_of(part_of(self.tensors, part)):
                kept = as_one(members[:critics], critics)
                tensors |= {f'{part}.{name}': value for name, value in kept.items()}
        known = {} if critics == self.critics == 1 else {'critics': min(critics, self.critics)}
        return replace(self, tensors=tensors, origin=self.origin | known)

    def completed(self, learner: ActorCritic) -> dict[str, Tensor]:
        """Return `tensors`; if they have critics, but too few, add critics of `learner`."""
        tensors = dict(self.tensors)
        for part, module in learner.modules.items():
            if given := members_of(part_of(self.tensors, part)):
                own = members_of(module.state_dict())
                complete = as_one(given + own[len(given) :], len(own))
                tensors |= {f'{part}.{name}': value for name, value in complete.items()}
        return tensors


def _described(shape: NetworkShape, goal_features: str) -> dict[str, object]:
    """Return sizes and inputs of networks, by the names that error messages use."""
    return {
        'observation': shape.observation_size,
        'goal': shape.goal_size,
        'action': shape.action_size,
        'hidden_sizes': shape.hidden_sizes,
        'layer_norm': shape.layer_norm,
        'goal_features': goal_features,
        'past_actions': shape.past_actions,
        'inputs': shape.feature_size,
    }


def read_initial_networks(name: str) -> InitialNetworks:
    """Read the networks that the field `init_from` names.

    Args:
        name: A run folder, for its latest networks; the name of a shipped actor; or the file of an
            actor. The critic of an actor is in `<Task>.training.safetensors` beside it, or in the
            training state of its run folder.

    Raises:
        ValueError: If the actor or run is missing or damaged, if its critic belongs to another
            actor, or if its training had one of the fields in `unusual_networks`.
    """
    path = Path(os.path.expanduser(name))
    latest = path / LATEST_FILE
    if latest.is_file() and not (path / STATE_FILE).is_file():
        # Runs of recipe `robust` have no training state.
        return _of_actor(str(latest), latest)
    return _of_run(path) if path.is_dir() else _of_actor(name, actor_path(name))


def _of_run(folder: Path) -> InitialNetworks:
    state, config = _read_usual(folder / STATE_FILE, folder)
    tensors = {
        key: value
        for key, value in state.tensors.items()
        if key.startswith(_PARTS) and '_optimizer.' not in key
    }
    origin = {
        'name': str(folder),
        'task': config.task,
        'env_steps': state.counters.env_steps,
        'command': state.extra.get('command', ''),
        'init_from': state.extra.get('init_from', {}),
    }
    tensors, shape = _unconditioned(tensors, config), network_shape(config)
    return InitialNetworks(tensors, shape, config.goal_features, config.control_hz, origin, config)


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
    digest, config = checkpoint.checkpoint_hash(path), None
    if source is not None:
        state, config = _read_usual(source, source)
        pairs = {each: (getattr(config, each), getattr(info, each)) for each in _SHARED}
        differing = [
            f'{n} {ours}, not {theirs}' for n, (ours, theirs) in pairs.items() if ours != theirs
        ]
        if differing or state.extra.get('actor_sha256', digest) != digest:
            reason = f': {"; ".join(differing)}' if differing else ''
            raise ValueError(f'{source} is the critic of another actor than {path}{reason}')
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
    return InitialNetworks(tensors, info.shape, info.goal_features, info.control_hz, origin, config)


def _read_usual(file: Path, source: Path) -> tuple[TrainingState, TrainConfig]:
    """Read a training state from `file` and return it with its configuration.

    Raises:
        ValueError: If the file is damaged, or its training had a field in `unusual_networks`.
    """
    state = read_state(file)
    config = config_from_dict(state.extra['config'])
    if found := unusual_networks(config):
        raise ValueError(f'a run cannot start from {source}: {", ".join(found)}')
    return state, config


def _unconditioned(tensors: dict[str, Tensor], config: TrainConfig) -> dict[str, Tensor]:
    """Return networks without the input for `condition` (success threshold or steps left).

    The biases then include the effect of this input, for the value that it has while the policy
    acts. Networks without such an input are returned unchanged.
    """
    value = acting_input(config)
    if value is None:
        return tensors
    return without_input(tensors, network_shape(config).feature_size, value)


def _sums(mean: Tensor, std: Tensor, count: int) -> dict[str, Tensor]:
    """Return `RunningStatistics` buffers for `count` inputs with this mean and deviation."""
    number = torch.tensor([float(max(count, 1))], dtype=torch.float64)
    mean, std = mean.double(), std.double()
    square = (std.square() + mean.square()) * number
    return {'count': number, 'total': mean * number, 'total_square': square}


def steps_behind(run: dict[str, Any]) -> int:
    """Return the total environment steps of an actor and of all networks that it started from.

    If several actors come from one run, the run counts once, with its latest actor.

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
    """Return a key that is equal for all actors of a run.

    `part` is a record of an actor or run, such as `init_from`. The key is the folder of the run. If
    the folder is unknown, the key is the pair of the hash or name and the environment `steps`.
    """
    name = part.get('name', '')
    if name and ',' not in name:
        if name.endswith('.safetensors'):
            return str(Path(name).parent)
        # The name of a run folder; only actors have a hash.
        if 'sha256' not in part:
            return str(Path(name))
    return (part.get('sha256') or name, steps)
