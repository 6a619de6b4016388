"""Networks, optimisers, normalisers and counters of a run in one safetensors file."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from policy_node.policies.files import (
    LARGEST_HEADER,
    LARGEST_POLICY,
    LARGEST_TENSOR_FILE,
    read_tensors,
    tensor_bytes,
    write_file,
)
from policy_node.training.experience.statistics import RunningStatistics
from policy_node.training.learners.actor_critic import HIGH_LEVEL, ActorCritic
from policy_node.training.runs.state_checks import (
    require_adam,
    require_counters,
    require_finite,
)

FORMAT = 'fetch_hand_training'
FORMAT_VERSION = 1
# Of an entry of the header: a name, a type, a shape and where the numbers lie.
_BYTES_OF_AN_ENTRY = 160


@dataclass(slots=True)
class Counters:
    """How far a run is.

    Attributes:
        env_steps: Environment steps of all workers.
        episodes: Episodes of all workers.
        updates: Gradient updates.
        seconds: Time spent, over all parts of a resumed run.
        processor_seconds: Processor time of all threads of this process, likewise.
        best_success: Best evaluated success so far; -1 before the first evaluation.
        best_return: Mean return of that evaluation.
        next_evaluation: Environment steps at which the next evaluation is due.
        narrowing_steps: Environment steps during which goals narrowed (`narrow_above`).
    """

    env_steps: int = 0
    episodes: int = 0
    updates: int = 0
    seconds: float = 0.0
    processor_seconds: float = 0.0
    best_success: float = -1.0
    best_return: float = -1e9
    next_evaluation: int = 0
    narrowing_steps: int = 0


@dataclass(frozen=True, slots=True)
class TrainingState:
    """What a file holds.

    Attributes:
        tensors: By part and name, `critic.network.output.bias`.
        counters: How far the run was.
        extra: JSON values: configuration, command, origin of the first networks.
    """

    tensors: dict[str, Tensor]
    counters: Counters
    extra: dict[str, Any]


def save_state(
    path: Path,
    learner: ActorCritic,
    statistics: dict[str, RunningStatistics],
    counters: Counters,
    extra: dict[str, Any],
) -> None:
    """Writes everything that a resumed run needs but the replay.

    Args:
        path: File to write.
        learner: The learner.
        statistics: The normalisers by name.
        counters: How far the run is.
        extra: JSON values to give back on load.
    """
    tensors: dict[str, Tensor] = {'torch_generator': torch.get_rng_state()}
    for part, module in learner.modules().items():
        for name, value in module.state_dict().items():
            tensors[f'{part}.{name}'] = value.detach().cpu()
    for part, optimizer in learner.optimizers().items():
        for index, state in optimizer.state_dict()['state'].items():
            for name, value in state.items():
                tensors[f'{part}.{index}.{name}'] = value.detach().cpu()
    for part, running in statistics.items():
        for name, value in running.state().items():
            tensors[f'{part}.{name}'] = value
    write_state(path, TrainingState(tensors, counters, extra))


def require_readable(learner: ActorCritic) -> None:
    """Refuses networks whose files could not be read back, before hours are spent on them.

    Raises:
        ValueError: One line names what is too large.
    """
    actor = sum(value.nbytes for value in learner.actor.state_dict().values())
    modules, optimizers = learner.modules().values(), learner.optimizers().values()
    values = [value for module in modules for value in module.state_dict().values()]
    moved = [each for optimizer in optimizers for each in optimizer.param_groups[0]['params']]
    # Adam keeps two numbers beside each, and a count.
    state = sum(value.nbytes for value in values) + 2 * sum(each.nbytes for each in moved)
    header = _BYTES_OF_AN_ENTRY * (len(values) + 3 * len(moved))
    for what, needed, allowed in (
        ('an actor', actor, LARGEST_POLICY),
        ('a training state', state, LARGEST_TENSOR_FILE),
        ('the header of a training state', header, LARGEST_HEADER),
    ):
        if needed > allowed:
            raise ValueError(
                f'hidden_sizes and critics make {what} of {needed:,} bytes; allowed: {allowed:,}'
            )


def write_state(path: Path, state: TrainingState) -> None:
    """Writes a state; the file is complete or not there."""
    write_file(path, state_bytes(state))


def state_bytes(state: TrainingState) -> bytes:
    """Returns what `write_state` writes."""
    values = {name: getattr(state.counters, name) for name in Counters.__slots__}
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    metadata |= {'counters': json.dumps(values), 'extra': json.dumps(state.extra)}
    return tensor_bytes(state.tensors, metadata)


def read_counters(path: Path) -> Counters:
    """Reads how far a run was when its state was written; its tensors stay untouched.

    Raises:
        ValueError: If the file is no training state of this version, or damaged.
    """
    return _described(path, read_tensors(path)[1])[0]


def read_state(path: Path) -> TrainingState:
    """Reads a training state.

    Raises:
        ValueError: If the file is no training state of this version, or damaged.
    """
    arrays, metadata = read_tensors(path)
    counters, extra = _described(path, metadata)
    tensors = {name: torch.tensor(values) for name, values in arrays.items()}
    try:
        require_finite(tensors)
    except ValueError as error:
        raise ValueError(f'{path} is damaged: {error}') from None
    return TrainingState(tensors, counters, extra)


def _described(path: Path, metadata: dict[str, str]) -> tuple[Counters, dict[str, Any]]:
    found = (metadata.get('format'), metadata.get('format_version'))
    if found != (FORMAT, str(FORMAT_VERSION)):
        raise ValueError(f'{path} is no training state of version {FORMAT_VERSION}: {found}')
    try:
        known = asdict(Counters())
        counters = Counters(**require_counters(json.loads(metadata['counters']), known))
        extra = dict(json.loads(metadata['extra']))
        objects = {'config': extra['config'], 'init_from': extra.get('init_from', {})}
        for name, value in objects.items():
            if not isinstance(value, dict):
                raise TypeError(f'{name} is no object')
    except KeyError as error:
        raise ValueError(f'{path} lacks {error.args[0]!r} in its metadata') from None
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f'{path} has unreadable metadata: {error}') from None
    return counters, extra


def load_state(
    path: Path, learner: ActorCritic, statistics: dict[str, RunningStatistics]
) -> TrainingState:
    """Fills learner and normalisers from a file and returns what it holds.

    Raises:
        ValueError: If the file is no training state or its tensors do not fit.
    """
    state = read_state(path)
    with fitting(path):
        torch.set_rng_state(state.tensors['torch_generator'])
        load_networks(state.tensors, learner, statistics)
        for part, optimizer in learner.optimizers().items():
            _load_optimizer(optimizer, part_of(state.tensors, part))
        if state.counters.updates > 0 and not part_of(state.tensors, 'critic_optimizer'):
            raise ValueError('critic_optimizer is missing')
    learner.updates = state.counters.updates
    return state


@contextmanager
def fitting(source: object) -> Iterator[None]:
    """What is raised where tensors are loaded becomes one line that says where they are from.

    Args:
        source: A file, or what networks are called.

    Raises:
        ValueError: If they do not fit.
    """
    try:
        yield
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{source} does not fit this configuration: {_reason(error)}') from None


def _reason(error: Exception) -> str:
    """What was wrong, in one line; torch says on its first one only where."""
    if isinstance(error, KeyError):
        return f'{error.args[0]} is missing'
    return ' '.join(line.strip() for line in str(error).splitlines()[:2])


def load_networks(
    tensors: dict[str, Tensor], learner: ActorCritic, statistics: dict[str, RunningStatistics]
) -> None:
    """Fills networks and normalisers; without a critic the learner keeps its own.

    Raises:
        RuntimeError: If sizes do not fit.
        KeyError: If a part is incomplete.
    """
    tensors = _with_copies(tensors)
    for part, module in learner.modules().items():
        if part_of(tensors, part) or 'actor' in part:
            module.load_state_dict(part_of(tensors, part))
    for part, running in statistics.items():
        running.load_state(part_of(tensors, part))


def part_of(tensors: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    """The tensors of one part, by their names in it."""
    prefix = f'{part}.'
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def _with_copies(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Targets and average where a file has none: they start at actor and critic."""
    sources = {
        'target_actor': 'actor.network',
        'average_actor': 'actor.network',
        'target_critic': 'critic',
    }
    copies = {
        f'{level}{part}.{name}': value
        for level in ('', HIGH_LEVEL)
        for part, source in sources.items()
        if not part_of(tensors, f'{level}{part}')
        for name, value in part_of(tensors, f'{level}{source}').items()
    }
    return tensors | copies


def _load_optimizer(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split('.')
        state.setdefault(int(index), {})[name] = value
    require_adam(optimizer, state)
    groups = optimizer.state_dict()['param_groups']
    optimizer.load_state_dict({'state': state, 'param_groups': groups})
