"""Actor checkpoints: safetensors files with metadata, never pickle.

The metadata must agree with the task and with the tensors before a network is built. A damaged or
crafted file never needs more memory than its size.
"""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.tasks import TaskSpec, substeps_per_tick, task_spec
from msgs_spec.text import one_line
from policy_node.policies.files import (
    LARGEST_HEADER,
    parse_tensors,
    read_file,
    sha256,
    tensor_bytes,
    write_file,
)
from policy_node.policies.goal_features import goal_features
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.policy import LoadedPolicy, Policy

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor

FORMAT = 'fetch_hand_actor'
FORMAT_VERSION = 1
MOST_PAST_ACTIONS = 16
MOST_LAYERS = 64


@dataclass(frozen=True, slots=True)
class ActorInfo:
    """The metadata of an actor.

    Attributes:
        task: Task that the actor was trained on.
        observation_layout: (name, size) of each part of the observation, in order.
        goal_size: Length of the goal.
        action_size: Length of the action.
        hidden_sizes: Width of each hidden layer.
        layer_norm: Whether hidden layers are normalised.
        control_hz: Action frequency of its training, Hz.
        seed: Seed of the training run.
        command: Command line of the training.
        source_revision: Git revision of the training code.
        env_steps: Environment steps of the training.
        config: Training configuration by field.
        success: Measured success and how it was measured; empty if unmeasured.
        goal_features: Network inputs: `plain` (observation and goal), `relative` (also the
            difference between desired and achieved goal), `symmetric` (of the goal only this
            difference; poses that look the same give equal inputs).
        init_from: Origin of the initial networks: `name`, `task`, `env_steps`, `init_from` (their
            own origin) and others. Empty for random networks.
        past_actions: Number of past actions among the inputs.
    """

    task: str
    observation_layout: tuple[tuple[str, int], ...]
    goal_size: int
    action_size: int
    hidden_sizes: tuple[int, ...]
    layer_norm: bool
    control_hz: float
    seed: int
    command: str = ''
    source_revision: str = ''
    env_steps: int = 0
    config: dict[str, Any] = field(default_factory=dict)
    success: dict[str, Any] = field(default_factory=dict)
    goal_features: str = 'plain'
    init_from: dict[str, Any] = field(default_factory=dict)
    past_actions: int = 0

    @property
    def shape(self) -> NetworkShape:
        """Sizes and inputs of the actor's network."""
        return NetworkShape(
            observation_size=sum(size for _, size in self.observation_layout),
            goal_size=self.goal_size,
            action_size=self.action_size,
            hidden_sizes=self.hidden_sizes,
            layer_norm=self.layer_norm,
            goal_features=goal_features(self.goal_features, task_spec(self.task)),
            past_actions=self.past_actions,
        )


@dataclass(frozen=True, slots=True)
class Checkpoint:
    """The checked contents of a checkpoint file.

    Attributes:
        info: The metadata.
        tensors: Weights and normalisers by their names in `Actor`, float32, all finite.
        sha256: SHA-256 of the file, hexadecimal.
    """

    info: ActorInfo
    tensors: dict[str, NDArray[np.float32]]
    sha256: str


def observation_layout(spec: TaskSpec) -> tuple[tuple[str, int], ...]:
    """Return (name, size) of each part of a task's observation, in order."""
    return tuple((part.name, part.size) for part in spec.observation)


def save(path: str | Path, actor: Actor, info: ActorInfo) -> None:
    """Write weights, normalisers and metadata; the file is complete or not written."""
    write_file(Path(path), to_bytes(actor, info))


def to_bytes(actor: Actor, info: ActorInfo) -> bytes:
    """Return the contents of a checkpoint file."""
    tensors = {name: value.detach().cpu() for name, value in actor.state_dict().items()}
    return tensor_bytes(tensors, to_metadata(info))


def to_metadata(info: ActorInfo) -> dict[str, str]:
    """Return metadata of a checkpoint or ONNX file: the format and the fields of `info` as JSON."""
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    for name, value in dataclasses.asdict(info).items():
        metadata[name] = json.dumps(value)
    return metadata


def read(path: str | Path, task: str | None = None) -> Checkpoint:
    """Read a checkpoint of the task `task`; with None, of any task.

    Raises:
        ValueError: If the file is missing, invalid, of an unknown version, or not of `task`. The
            message is one line.
    """
    data = read_file(Path(path))
    tensors, metadata = parse_tensors(data, path)
    info = parse_metadata(metadata, path)
    if task is not None and info.task != task:
        raise ValueError(f'{path} was trained on {info.task}, not on {task}')
    _check_tensors(path, tensors, info.shape)
    return Checkpoint(info, tensors, sha256(data))


def read_info(path: str | Path) -> ActorInfo:
    """Read only the metadata of a checkpoint.

    Raises:
        ValueError: If the file is missing or not an actor checkpoint of this version.
    """
    return parse_metadata(parse_tensors(read_file(Path(path)), path)[1], path)


def load(path: str | Path, task: str | None = None) -> tuple[Actor, ActorInfo]:
    """Load a torch actor, without gradients, and its metadata; raises ValueError as `read` does."""
    import torch

    from policy_node.policies.actor import Actor

    checkpoint = read(path, task)
    actor = Actor(checkpoint.info.shape)
    actor.load_state_dict({name: torch.tensor(v) for name, v in checkpoint.tensors.items()})
    return actor.eval().requires_grad_(False), checkpoint.info


def loaded_actor(policy: Policy, info: ActorInfo, path: Path, digest: str) -> LoadedPolicy:
    """Wrap a policy read from a checkpoint or ONNX file; `digest` is the SHA-256 of the file."""
    return LoadedPolicy(policy, info.task, f'actor {path.name}', info.control_hz, digest)


def checkpoint_hash(path: str | Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    return sha256(read_file(Path(path)))


def parse_metadata(metadata: dict[str, str], path: str | Path) -> ActorInfo:
    """Return the checked metadata of a checkpoint or ONNX file; errors name its `path`.

    Raises:
        ValueError: If a field is missing or invalid, or does not fit the task or the version.
    """
    _check_format(path, metadata)
    if sum(map(len, metadata.values())) > LARGEST_HEADER:
        raise ValueError(f'{path} has more than {LARGEST_HEADER} characters of metadata')
    # Older files lack these fields.
    metadata = {'goal_features': '"plain"', 'init_from': '{}', 'past_actions': '0', **metadata}
    fields = {field.name: field.type for field in dataclasses.fields(ActorInfo)}
    missing = [name for name in fields if name not in metadata]
    if missing:
        raise ValueError(f'{path} lacks metadata: {", ".join(missing)}')
    values = {}
    for name, kind in fields.items():
        try:
            values[name] = _READERS[kind](json.loads(metadata[name]))
        except (ArithmeticError, RecursionError, TypeError, ValueError) as error:
            line = one_line(error)
            raise ValueError(f'{path} has unreadable metadata: {name}: {line}') from None
    info = ActorInfo(**values)
    _check_sizes(path, info)
    return info


def _check_format(path: str | Path, metadata: dict[str, str]) -> None:
    if metadata.get('format') != FORMAT:
        raise ValueError(
            f'{path} has format {metadata.get("format")!r:.80}; '
            'allowed: files of fetch_hand_sim train and export'
        )
    version = metadata.get('format_version')
    if version != str(FORMAT_VERSION):
        raise ValueError(
            f'{path} has format version {one_line(version, 20)}; supported: {FORMAT_VERSION}'
        )


def _check_sizes(path: str | Path, info: ActorInfo) -> None:
    try:
        spec = task_spec(info.task)
        goal_features(info.goal_features, spec)
    except ValueError as error:
        raise ValueError(f'{path} has {error}') from None
    if not 0 <= info.past_actions <= MOST_PAST_ACTIONS:
        raise ValueError(
            f'{path} has past_actions {info.past_actions!s:.80}; allowed: 0 ... {MOST_PAST_ACTIONS}'
        )
    if len(info.hidden_sizes) > MOST_LAYERS:
        raise ValueError(
            f'{path} has {len(info.hidden_sizes)} hidden layers; allowed: up to {MOST_LAYERS}'
        )
    expected = (observation_layout(spec), spec.goal.size, spec.robot.action_size)
    found = (info.observation_layout, info.goal_size, info.action_size)
    for name, given, wanted in zip(('observation', 'goal', 'action'), found, expected, strict=True):
        if given != wanted:
            raise ValueError(f'{path} has {name} {given!s:.200}; {info.task} has {wanted}')


def _check_tensors(
    path: str | Path, tensors: dict[str, NDArray[np.float32]], shape: NetworkShape
) -> None:
    wanted = shape.tensor_shapes()
    found = {name: values.shape for name, values in tensors.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if found.get(name) != wanted.get(name):
            given, allowed = found.get(name, 'none'), wanted.get(name, 'none')
            raise ValueError(
                f'{path} has tensor {one_line(name, 80)} {given!s:.80}; '
                f'its metadata require {allowed!s:.80}'
            )
    for name, values in tensors.items():
        if values.dtype != np.float32:
            raise ValueError(f'{path} has tensor {name} of {values.dtype}; allowed: float32')
        if not np.isfinite(values).all():
            raise ValueError(f'{path} has tensor {name} with a value that is not finite')
        if name.endswith('_normalizer.std') and not (values > 0).all():
            raise ValueError(f'{path} has tensor {name} with a value that is not above 0')


# Readers of metadata values.


def _of_type(kind: type, name: str) -> Callable[[object], Any]:
    """Return a function that returns its argument, or raises TypeError if its type is not `kind`.

    Booleans are not numbers. The error calls the type `name`.
    """

    def read_value(value: object) -> Any:
        if type(value) is not kind:
            raise TypeError(f'{value!r:.80} is not {name}')
        return value

    return read_value


_text = _of_type(str, 'text')
_whole = _of_type(int, 'a whole number')
_list = _of_type(list, 'a list')


def _rate(value: object) -> float:
    rate = float(value) if type(value) is int else _of_type(float, 'a number')(value)
    substeps_per_tick(rate)
    return float(rate)


def _widths(value: object) -> tuple[int, ...]:
    widths = tuple(_whole(width) for width in _list(value))
    if any(width < 1 for width in widths):
        raise ValueError(f'{value!r:.80}; allowed: widths of 1 or more')
    return widths


def _layout(value: object) -> tuple[tuple[str, int], ...]:
    return tuple((_text(name), _whole(size)) for name, size in _list(value))


_READERS: dict[Any, Callable[[Any], Any]] = {
    'str': _text,
    'int': _whole,
    'bool': _of_type(bool, 'true or false'),
    'float': _rate,
    'dict[str, Any]': _of_type(dict, 'an object'),
    'tuple[int, ...]': _widths,
    'tuple[tuple[str, int], ...]': _layout,
}
"""By the type of a field of `ActorInfo`."""
