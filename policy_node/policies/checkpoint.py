"""Actor checkpoints: safetensors files whose metadata say what the weights fit. Never pickle."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from safetensors import SafetensorError, safe_open
from safetensors.torch import save as to_bytes
from torch import Tensor

from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from policy_node.policies.actor import Actor, NetworkShape
from policy_node.policies.goal_features import goal_features

FORMAT = 'fetch_hand_actor'
FORMAT_VERSION = 1


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
        )


def observation_layout(spec: TaskSpec) -> tuple[tuple[str, int], ...]:
    """(name, size) of each part of a task's observation, in order."""
    return tuple((part.name, part.size) for part in spec.observation)


def save(path: str | Path, actor: Actor, info: ActorInfo) -> None:
    """Writes weights, normaliser and metadata to `path`; the file is complete or not there."""
    if actor.shape != info.shape:
        raise ValueError(f'actor has shape {actor.shape}, its metadata say {info.shape}')
    tensors = {name: value.detach().cpu() for name, value in actor.state_dict().items()}
    metadata = {'format': FORMAT, 'format_version': str(FORMAT_VERSION)}
    for name, value in dataclasses.asdict(info).items():
        metadata[name] = json.dumps(value)
    write_tensors(path, tensors, metadata)


def write_tensors(path: str | Path, tensors: dict[str, Tensor], metadata: dict[str, str]) -> None:
    """Writes a safetensors file under a temporary name and moves it into place."""
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f'.{path.name}.partial')
    contents = to_bytes({name: value.contiguous() for name, value in tensors.items()}, metadata)
    try:
        partial.write_bytes(contents)
        os.replace(partial, path)
    except OSError:
        partial.unlink(missing_ok=True)
        raise


def read_tensors(path: str | Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    """Reads tensors and metadata of a safetensors file.

    Raises:
        ValueError: If it cannot be read or is not one.
    """
    try:
        with safe_open(path, framework='pt') as file:
            return {name: file.get_tensor(name) for name in file.keys()}, file.metadata() or {}
    except (OSError, SafetensorError) as error:
        raise ValueError(f'{path} is not a readable safetensors file: {error}') from None


def read_info(path: str | Path) -> ActorInfo:
    """Reads only the metadata of an actor checkpoint.

    Raises:
        ValueError: If it is no actor checkpoint of this version.
    """
    return _info(path, read_tensors(path)[1])


def load(path: str | Path, task: str | None = None) -> tuple[Actor, ActorInfo]:
    """Loads an actor and what is known about it.

    Args:
        path: Checkpoint file.
        task: Refuse a checkpoint of any other task.

    Raises:
        ValueError: If the file is no checkpoint, of an unknown version, of another task, or its
            sizes do not fit the task; one line names what was found and what is expected.
    """
    tensors, metadata = read_tensors(path)
    info = _info(path, metadata)
    if task is not None and info.task != task:
        raise ValueError(f'{path} was trained on {info.task}, not on {task}')
    _check_sizes(path, info)
    actor = Actor(info.shape)
    _check_tensors(path, tensors, actor)
    actor.load_state_dict(tensors)
    return actor.eval().requires_grad_(False), info


def checkpoint_hash(path: str | Path) -> str:
    """SHA-256 of the file, hexadecimal."""
    with open(path, 'rb') as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()


def _info(path: str | Path, metadata: dict[str, str]) -> ActorInfo:
    if metadata.get('format') != FORMAT:
        raise ValueError(f'{path} is no actor checkpoint (format {metadata.get("format")!r})')
    version = metadata.get('format_version')
    if version != str(FORMAT_VERSION):
        raise ValueError(f'{path} has format version {version}; supported: {FORMAT_VERSION}')
    # Files from before there were goal features have plain ones, and started from nothing.
    metadata = {'goal_features': '"plain"', 'init_from': '{}', **metadata}
    names = [item.name for item in dataclasses.fields(ActorInfo)]
    missing = [name for name in names if name not in metadata]
    if missing:
        raise ValueError(f'{path} lacks metadata: {", ".join(missing)}')
    try:
        values = {name: json.loads(metadata[name]) for name in names}
        values['observation_layout'] = tuple(
            (str(name), int(size)) for name, size in values['observation_layout']
        )
        values['hidden_sizes'] = tuple(int(width) for width in values['hidden_sizes'])
    except (ValueError, TypeError) as error:
        raise ValueError(f'{path} has unreadable metadata: {error}') from None
    return ActorInfo(**values)


def _check_sizes(path: str | Path, info: ActorInfo) -> None:
    if info.task not in TASKS:
        raise ValueError(f'{path} was trained on unknown task {info.task!r}')
    spec = TASKS[info.task]
    try:
        goal_features(info.goal_features, spec)
    except ValueError as error:
        raise ValueError(f'{path}: {error}') from None
    expected = (observation_layout(spec), spec.goal.size, spec.robot.action_size)
    found = (info.observation_layout, info.goal_size, info.action_size)
    for name, given, wanted in zip(('observation', 'goal', 'action'), found, expected, strict=True):
        if given != wanted:
            raise ValueError(f'{path} has {name} {given}; {info.task} has {wanted}')


def _check_tensors(path: str | Path, tensors: dict[str, Tensor], actor: Actor) -> None:
    wanted = {name: tuple(value.shape) for name, value in actor.state_dict().items()}
    found = {name: tuple(value.shape) for name, value in tensors.items()}
    for name in sorted(wanted.keys() | found.keys()):
        if found.get(name) != wanted.get(name):
            given, allowed = found.get(name, 'none'), wanted.get(name, 'none')
            raise ValueError(f'{path} has tensor {name} {given}; its metadata ask for {allowed}')
