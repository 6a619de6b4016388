"""The training state of a run: networks, optimizers, normalizers and counters in one file."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor, nn

from policy_node.policies.files import (
    LARGEST_POLICY,
    LARGEST_TENSOR_FILE,
    read_tensors,
    tensor_bytes,
    write_file,
)
from policy_node.training.learners.actor_critic import ActorCritic

FORMAT = 'fetch_hand_training'
FORMAT_VERSION = 1
# Counts up to here are exact as float64.
_LARGEST_COUNT = 2**53
# Tensors of Adam for each parameter.
_ADAM = {'step', 'exp_avg', 'exp_avg_sq'}


@dataclass(slots=True)
class Counters:
    """The progress of a run since its first start; a resumed run continues to count.

    Attributes:
        env_steps: Environment steps of all workers.
        episodes: Episodes of all workers.
        updates: Gradient updates.
        seconds: Wall-clock time.
        processor_seconds: CPU time of all threads of this process.
        best_success: Best evaluated success rate; -1 before the first evaluation.
        best_return: Mean return in the evaluation of `best_success`.
        next_evaluation: Value of `env_steps` at which the next evaluation is due.
    """

    env_steps: int = 0
    episodes: int = 0
    updates: int = 0
    seconds: float = 0.0
    processor_seconds: float = 0.0
    best_success: float = -1.0
    best_return: float = -1e9
    next_evaluation: int = 0


class RunClock:
    """Adds the wall-clock and CPU time since the clock was created to those in `counters`."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._wall_start = time.monotonic() - counters.seconds
        self._cpu_start = time.process_time() - counters.processor_seconds

    def update(self) -> None:
        """Set `seconds` and `processor_seconds` of the counters to the totals until now."""
        self._counters.seconds = time.monotonic() - self._wall_start
        self._counters.processor_seconds = time.process_time() - self._cpu_start


@dataclass(frozen=True, slots=True)
class TrainingState:
    """The contents of a training state file.

    Attributes:
        tensors: Tensors by part and name, for example `critic.network.output.bias`.
        counters: Progress of the run.
        extra: JSON values. `config` is the configuration; `command` and `init_from` (origin of the
            initial networks) may be missing.
    """

    tensors: dict[str, Tensor]
    counters: Counters
    extra: dict[str, Any]


def save_state(
    path: Path,
    learner: ActorCritic,
    statistics: Mapping[str, nn.Module],
    counters: Counters,
    extra: dict[str, Any],
) -> None:
    """Write all that a resumed run needs, except the replay, to the file `path`.

    `statistics` are the modules of the normalizers by name; for `extra` see `TrainingState`.
    """
    tensors: dict[str, Tensor] = {'torch_generator': torch.get_rng_state()}
    for part, module in {**learner.modules, **statistics}.items():
        for name, value in module.state_dict().items():
            tensors[f'{part}.{name}'] = value.detach().cpu()
    for part, optimizer in learner.optimizers.items():
        for index, state in optimizer.state_dict()['state'].items():
            for name, value in state.items():
                tensors[f'{part}.{index}.{name}'] = value.detach().cpu()
    write_file(path, state_bytes(TrainingState(tensors, counters, extra)))


def state_bytes(state: TrainingState) -> bytes:
    """Return a training state as the bytes of its file."""
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    metadata |= {
        'counters': json.dumps(asdict(state.counters)),
        'extra': json.dumps(state.extra),
    }
    return tensor_bytes(state.tensors, metadata)


def require_readable(learner: ActorCritic) -> None:
    """Raise ValueError if the networks of `learner` are too large for the files of a run.

    The actor file may have 64 MiB, the training state file 1 GiB. Larger files cannot be read.
    """
    actor = sum(value.nbytes for value in learner.actor.state_dict().values())
    modules, optimizers = learner.modules.values(), learner.optimizers.values()
    state = sum(value.nbytes for module in modules for value in module.state_dict().values())
    # Adam keeps two numbers for each.
    state += 2 * sum(v.nbytes for each in optimizers for v in each.param_groups[0]['params'])
    for what, needed, allowed in (
        ('an actor', actor, LARGEST_POLICY),
        ('a training state', state, LARGEST_TENSOR_FILE),
    ):
        if needed > allowed:
            raise ValueError(
                f'hidden_sizes and critics make {what} of {needed:,} bytes; allowed: {allowed:,}'
            )


def read_counters(path: Path) -> Counters:
    """Read only the progress of a run from its training state file.

    Raises:
        ValueError: If the file is not a training state of this version, or damaged.
    """
    return _described(path, read_tensors(path)[1])[0]


def read_state(path: Path) -> TrainingState:
    """Read a training state file.

    Raises:
        ValueError: If the file is not a training state of this version, or damaged.
    """
    arrays, metadata = read_tensors(path)
    counters, extra = _described(path, metadata)
    tensors = {name: torch.tensor(values) for name, values in arrays.items()}
    for name, value in arrays.items():
        if not np.isfinite(value).all():
            raise ValueError(f'{path} is damaged: {name} has a value that is not finite')
    return TrainingState(tensors, counters, extra)


def _described(path: Path, metadata: dict[str, str]) -> tuple[Counters, dict[str, Any]]:
    found = (metadata.get('format'), metadata.get('format_version'))
    if found != (FORMAT, str(FORMAT_VERSION)):
        raise ValueError(f'{path} has format {found}; allowed: {FORMAT} {FORMAT_VERSION}')
    try:
        counters = _counters(json.loads(metadata['counters']))
        extra = dict(json.loads(metadata['extra']))
        for name, value in (('config', extra['config']), ('init_from', extra.get('init_from', {}))):
            if not isinstance(value, dict):
                raise TypeError(f'{name} is not an object')
    except KeyError as error:
        raise ValueError(f'{path} lacks {error.args[0]!r} in its metadata') from None
    except (ValueError, TypeError, RecursionError) as error:
        raise ValueError(f'{path} has unreadable metadata: {error}') from None
    return counters, extra


def _counters(values: Any) -> Counters:
    known = asdict(Counters())
    # Version 1.1 also counted these.
    values = {name: value for name, value in dict(values).items() if name != 'narrowing_steps'}
    for name, value in values.items():
        if isinstance(known.get(name), int):
            is_valid = type(value) is int and 0 <= value <= _LARGEST_COUNT
        else:
            is_valid = is_finite(value)
        if not is_valid:
            raise ValueError(f'counter {name} is {value!r:.80}')
    return Counters(**values)


def is_finite(value: object) -> TypeGuard[int | float]:
    """Return whether a value is a finite number; booleans are not numbers."""
    return isinstance(value, int | float) and type(value) is not bool and math.isfinite(value)


def load_state(path: Path, learner: ActorCritic, modules: dict[str, nn.Module]) -> TrainingState:
    """Load a training state file into `modules` and into the optimizers of `learner`; return it.

    `modules` are the networks and normalizer statistics by name. The random generator of torch
    and `learner.updates` are restored too.

    Raises:
        ValueError: If the file is not a training state or its tensors do not fit.
    """
    state = read_state(path)
    with fitting(path):
        torch.set_rng_state(state.tensors['torch_generator'])
        load_networks(state.tensors, modules)
        for part, optimizer in learner.optimizers.items():
            _load_optimizer(optimizer, part_of(state.tensors, part))
        if state.counters.updates > 0 and not part_of(state.tensors, 'critic_optimizer'):
            raise ValueError('critic_optimizer is missing')
    learner.updates = state.counters.updates
    return state


@contextmanager
def fitting(source: object) -> Iterator[None]:
    """Context manager that converts errors of a block that loads tensors to a ValueError.

    The errors are RuntimeError, KeyError, TypeError and ValueError. The message, one line, reports
    that `source`, the file or policy of the tensors, does not fit the configuration.
    """
    try:
        yield
    except (RuntimeError, KeyError, TypeError, ValueError) as error:
        if isinstance(error, KeyError):
            reason = f'{error.args[0]} is missing'
        else:
            # The first line of torch names the module, the second the problem.
            reason = ' '.join(line.strip() for line in str(error).splitlines()[:2])
        raise ValueError(f'{source} does not fit this configuration: {reason}') from None


def load_networks(tensors: dict[str, Tensor], modules: dict[str, nn.Module]) -> None:
    """Load `tensors` into `modules`, the networks and normalizer statistics by name.

    Missing target networks and a missing averaged actor become copies of actor and critic, a
    missing start actor a copy of the averaged actor. A missing critic, or other module except
    actors and statistics, keeps its weights.

    Raises:
        RuntimeError: If sizes do not fit, if an actor or statistics are missing, or if some
            tensors of a module are.
    """
    tensors = _with_copies(tensors, modules)
    for part, module in modules.items():
        if part_of(tensors, part) or 'actor' in part or 'statistics' in part:
            module.load_state_dict(part_of(tensors, part))


def part_of(tensors: dict[str, Tensor], part: str) -> dict[str, Tensor]:
    """Return the tensors whose names start with `part` and a dot, without this prefix."""
    prefix = f'{part}.'
    return {
        name.removeprefix(prefix): value
        for name, value in tensors.items()
        if name.startswith(prefix)
    }


def _with_copies(tensors: dict[str, Tensor], modules: Iterable[str]) -> dict[str, Tensor]:
    """Return `tensors`, with copies of actor and critic for missing target and other networks.

    `modules` are the names of the networks and statistics that a run needs.
    """
    sources = {
        'target_actor': 'actor.network',
        'average_actor': 'actor.network',
        'start_actor': 'average_actor' if part_of(tensors, 'average_actor') else 'actor.network',
        'target_critic': 'critic',
    }
    copies = {
        f'{part}.{name}': value
        for part in modules
        for ending, source in sources.items()
        if part.endswith(ending) and not part_of(tensors, part)
        for name, value in part_of(tensors, part.removesuffix(ending) + source).items()
    }
    return tensors | copies


def _load_optimizer(optimizer: torch.optim.Adam, tensors: dict[str, Tensor]) -> None:
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split('.')
        state.setdefault(int(index), {})[name] = value
    parameters = optimizer.param_groups[0]['params']
    for number, values in state.items():
        if not 0 <= number < len(parameters) or values.keys() != _ADAM:
            raise ValueError(f'parameter {number} has {sorted(values)}')
        for name, value in values.items():
            # Adam would write beyond the end of a smaller tensor.
            needed = () if name == 'step' else tuple(parameters[number].shape)
            if tuple(value.shape) != needed or not value.is_floating_point():
                given = f'{tuple(value.shape)} {value.dtype}'
                raise ValueError(f'{name} of parameter {number} is {given}, not {needed}')
    groups = optimizer.state_dict()['param_groups']
    optimizer.load_state_dict({'state': state, 'param_groups': groups})


class TrainingError(RuntimeError):
    """Raised if training cannot continue; the message contains the step and the cause."""


def require_finite(values: Iterable[tuple[str, Any]], counters: Counters) -> None:
    """Raise `TrainingError` with `counters` if a number or array, (name, value), is not finite."""
    for name, value in values:
        if not np.isfinite(np.asarray(value)).all():
            raise TrainingError(
                f'{name} is not finite after {counters.env_steps} environment steps and '
                f'{counters.updates} updates'
            )
