"""Actor checkpoints: safetensors files whose metadata say what the weights fit. Never pickle.

What a file declares is compared with its task and its tensors before anything is made of it, so a
damaged or crafted one costs no more than its size.
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

from msgs_spec.tasks import TASKS, TaskSpec, substeps_per_tick, task_spec
from msgs_spec.text import one_line
from policy_node.policies.files import read_file, sha256, write_file
from policy_node.policies.goal_features import goal_features
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.policy import LoadedPolicy, Policy
from policy_node.policies.tensor_file import (
    TensorHeader,
    parse_header,
    parse_tensors,
    tensor_bytes,
)

if TYPE_CHECKING:
    from policy_node.policies.actor import Actor

FORMAT = 'fetch_hand_actor'
FORMAT_VERSION = 1
MOST_PAST_ACTIONS = 16
MOST_LAYERS = 64


@dataclass(frozen=True, slots=True)
class ActorInfo:
    """What a checkpoint says about its actor.

    Attributes:
        task: Task it was trained on.
        observation_layout: (name, size) of each part of the observation, in order.
        goal_size: Length of the goal.
        action_size: Length of the action.
        hidden_sizes: Width of each hidden layer.
        layer_norm: Whether hidden layers are normalised.
        control_hz: Action frequency it was trained at, Hz.
        seed: Seed of the training run.
        command: Command line that trained it.
        source_revision: Revision of the source that trained it.
        env_steps: Environment steps behind the weights.
        config: The training configuration.
        success: Measured success and how it was measured; empty if unmeasured.
        goal_features: How observation and goal become inputs: `plain`, `relative`, `symmetric`.
        init_from: What its training started from: name, task, environment steps, and what that
            had started from; empty if from nothing.
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
        """Shape of the network the weights belong to."""
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
    """The contents of a file, checked.

    Attributes:
        info: What it says about its actor.
        tensors: Weights and normalisers by their names in `Actor`, float32, all finite.
        sha256: Fingerprint of the file.
    """

    info: ActorInfo
    tensors: dict[str, NDArray[np.float32]]
    sha256: str


def observation_layout(spec: TaskSpec) -> tuple[tuple[str, int], ...]:
    """(name, size) of each part of a task's observation, in order."""
    return tuple((part.name, part.size) for part in spec.observation)


def save(path: str | Path, actor: Actor, info: ActorInfo) -> None:
    """Writes weights, normaliser and metadata to `path`; the file is complete or not there."""
    write_file(Path(path), to_bytes(actor, info))


def to_bytes(actor: Actor, info: ActorInfo) -> bytes:
    """Returns what `save` writes.

    Raises:
        ValueError: If the metadata are of an actor of another shape.
    """
    if actor.shape != info.shape:
        raise ValueError(f'actor has shape {actor.shape}, its metadata say {info.shape}')
    tensors = {name: value.detach().cpu() for name, value in actor.state_dict().items()}
    return tensor_bytes(tensors, to_metadata(info))


def to_metadata(info: ActorInfo) -> dict[str, str]:
    """Returns the metadata of an actor's file, whatever its format."""
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    for name, value in dataclasses.asdict(info).items():
        metadata[name] = json.dumps(value)
    return metadata


def read(path: str | Path, task: str | None = None) -> Checkpoint:
    """Reads a checkpoint.

    Args:
        path: Checkpoint file.
        task: Refuse a checkpoint of any other task.

    Raises:
        ValueError: If the file is no checkpoint, of an unknown version, of another task, its sizes
            do not fit the task, or a weight is not finite; one line names what was found and what
            is allowed.
    """
    data = read_file(Path(path))
    header = parse_header(data, path)
    info = parse_metadata(header.metadata, path)
    if task is not None and info.task != task:
        raise ValueError(f'{path} was trained on {info.task}, not on {task}')
    _check_tensors(path, header, info.shape)
    tensors = parse_tensors(data, path)
    _check_values(path, tensors)
    return Checkpoint(info, tensors, sha256(data))


def read_info(path: str | Path) -> ActorInfo:
    """Reads only the metadata of an actor checkpoint.

    Raises:
        ValueError: If it is no actor checkpoint of this version.
    """
    return parse_metadata(parse_header(read_file(Path(path)), path).metadata, path)


def load(path: str | Path, task: str | None = None) -> tuple[Actor, ActorInfo]:
    """Loads an actor as a torch module, and what is known about it.

    Raises:
        ValueError: As `read`.
    """
    from policy_node.policies.actor import Actor

    checkpoint = read(path, task)
    return Actor.from_arrays(checkpoint.info.shape, checkpoint.tensors), checkpoint.info


def loaded_actor(policy: Policy, info: ActorInfo, path: Path, digest: str) -> LoadedPolicy:
    """An actor of this project and what its file says about it, whatever the format.

    Args:
        policy: What acts.
        info: What the metadata say.
        path: The file.
        digest: Its fingerprint.
    """
    return LoadedPolicy(policy, info.task, f'actor {path.name}', info.control_hz, digest)


def checkpoint_hash(path: str | Path) -> str:
    """SHA-256 of the file, hexadecimal."""
    return sha256(read_file(Path(path)))


def parse_metadata(metadata: dict[str, str], path: str | Path) -> ActorInfo:
    """Returns what the metadata of an actor's file say, whatever its format.

    Raises:
        ValueError: If they are none of this version or do not fit a task; `path` names the file.
    """
    _check_format(path, metadata)
    # Files from before there were goal features have plain ones, and started from nothing.
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
            f'{path} is no policy of this project (format {metadata.get("format")!r:.80}); '
            'allowed: files that fetch_hand_sim train and export write'
        )
    version = metadata.get('format_version')
    if version != str(FORMAT_VERSION):
        raise ValueError(
            f'{path} has format version {one_line(version, 20)}; supported: {FORMAT_VERSION}'
        )


def _check_sizes(path: str | Path, info: ActorInfo) -> None:
    if info.task not in TASKS:
        raise ValueError(f'{path} was trained on unknown task {info.task!r:.80}')
    spec = TASKS[info.task]
    try:
        goal_features(info.goal_features, spec)
    except ValueError as error:
        raise ValueError(f'{path} has {one_line(error)}') from None
    if not 0 <= info.past_actions <= MOST_PAST_ACTIONS:
        raise ValueError(
            f'{path} has past_actions {info.past_actions}; allowed: 0 ... {MOST_PAST_ACTIONS}'
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


def _check_tensors(path: str | Path, header: TensorHeader, shape: NetworkShape) -> None:
    wanted, found = shape.tensor_shapes(), header.shapes
    for name in sorted(wanted.keys() | found.keys()):
        if found.get(name) != wanted.get(name):
            given, allowed = found.get(name, 'none'), wanted.get(name, 'none')
            raise ValueError(
                f'{path} has tensor {one_line(name, 80)} {given!s:.80}; '
                f'its metadata ask for {allowed}'
            )
        if header.types[name] != 'F32':
            raise ValueError(f'{path} has tensor {name} of {header.types[name]:.8}; allowed: F32')


def _check_values(path: str | Path, tensors: dict[str, NDArray[np.float32]]) -> None:
    for name, values in tensors.items():
        if not np.isfinite(values).all():
            raise ValueError(f'{path} has tensor {name} with a value that is not finite')
        if name.endswith('_normalizer.std') and not (values > 0).all():
            raise ValueError(f'{path} has tensor {name} with a value that is not above 0')


# What a value of the metadata may be.


def _of_type(kind: type, complaint: str) -> Callable[[object], Any]:
    """What reads a value of a type of JSON, for which true is no number."""

    def read_value(value: object) -> Any:
        if type(value) is not kind:
            raise TypeError(f'{value!r:.80} {complaint}')
        return value

    return read_value


_text = _of_type(str, 'is no text')
_whole = _of_type(int, 'is no whole number')
_flag = _of_type(bool, 'is neither true nor false')
_object = _of_type(dict, 'is no object')


def _rate(value: object) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise TypeError(f'{value!r:.80} is no number')
    substeps_per_tick(float(value))
    return float(value)


def _widths(value: object) -> tuple[int, ...]:
    if not isinstance(value, list):
        raise TypeError(f'{value!r:.80} is no list')
    widths = tuple(_whole(width) for width in value)
    if any(width < 1 for width in widths):
        raise ValueError(f'{value!r:.80}; allowed: widths of 1 or more')
    return widths


def _layout(value: Any) -> tuple[tuple[str, int], ...]:
    return tuple((_text(name), _whole(size)) for name, size in value)


_READERS: dict[Any, Callable[[Any], Any]] = {
    'str': _text,
    'int': _whole,
    'bool': _flag,
    'float': _rate,
    'dict[str, Any]': _object,
    'tuple[int, ...]': _widths,
    'tuple[tuple[str, int], ...]': _layout,
}
"""By the type of a field of `ActorInfo`."""
