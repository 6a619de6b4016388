"""Who answers a robot: a trained actor, or a random or resting one where there is none."""

from __future__ import annotations

import hashlib
import zlib
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from msgs_spec.actions import command_from_action
from msgs_spec.tasks import TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus

Observation = dict[str, NDArray[np.float64]]

RANDOM, RESTING = 'random', 'resting'
_WARM_UP_CALLS = 20


class Commander(Protocol):
    """Turns observations into commands for one task.

    Attributes:
        spec: The task.
        description: Who it is, for people.
        sha256: Fingerprint of its checkpoint; empty if it has none.
    """

    spec: TaskSpec
    description: str
    sha256: str

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the command (action size,), command units, for one observation."""
        ...


class RandomCommander:
    """Uniform random actions. The seed is the task's name, so that runs are alike."""

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.description = 'a random commander'
        self.sha256 = ''
        self._generator = np.random.default_rng(zlib.crc32(spec.name.encode()))

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns a random command, whatever the observation."""
        del observation
        action = self._generator.uniform(-1.0, 1.0, self.spec.robot.action_size)
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)


class RestingCommander:
    """The zero action: the gripper stays, the hand goes to the middle of its ranges."""

    def __init__(self, spec: TaskSpec) -> None:
        self.spec = spec
        self.description = 'a resting commander'
        self.sha256 = ''
        action = np.zeros(spec.robot.action_size)
        self._command = np.asarray(command_from_action(spec.robot, action), dtype=np.float64)

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the resting command, whatever the observation."""
        del observation
        return self._command


class ActorCommander:
    """An actor of this project, on one thread."""

    def __init__(self, path: Path, spec: TaskSpec, sha256: str) -> None:
        """Loads a checkpoint.

        Raises:
            ValueError: If it was trained on another task or cannot be read.
        """
        import torch

        from policy_node.policies import checkpoint

        torch.set_num_threads(1)
        self._actor, info = checkpoint.load(path, spec.name)
        self.control_hz: float | None = info.control_hz
        self.spec = spec
        self.description = f'actor {path.name}'
        self.sha256 = sha256

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the actor's command."""
        action, _ = self._actor.predict(observation, deterministic=True)
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)


def make_commander(checkpoint: str, status: EpisodeStatus) -> Commander:
    """Makes the commander that a robot gets.

    Args:
        checkpoint: Name of a shipped actor; path of a checkpoint of this project, of an ONNX file
            or of a .zip of Stable-Baselines3; `random`, `resting`; or '' for the shipped actor of
            the robot's task.
        status: What the robot said of itself.

    Raises:
        ValueError: If there is no such actor or it does not fit the robot; one line says why.
    """
    spec = task_spec(status.task)
    if checkpoint == RANDOM:
        return RandomCommander(spec)
    if checkpoint == RESTING:
        return RestingCommander(spec)
    if not checkpoint:
        return _shipped_commander(status)
    return _load_commander(checkpoint, status)


def _shipped_commander(status: EpisodeStatus) -> Commander:
    from policy_node.policies.shipped import shipped_actors

    shipped = shipped_actors()
    if status.task not in shipped:
        raise ValueError(
            f'no actor is shipped for {status.task} (shipped: {", ".join(shipped) or "none"}); '
            f'give a checkpoint, or {RANDOM!r} or {RESTING!r}'
        )
    return _load_commander(status.task, status)


def _load_commander(name_or_path: str, status: EpisodeStatus) -> Commander:
    """Loads an actor by the ending of its file, checks its rate and warms it up."""
    path = _actor_path(name_or_path)
    spec = task_spec(status.task)
    commander: Any = _commander_class(path)(path, spec, _sha256(path))
    if commander.control_hz not in (None, status.control_hz):
        raise ValueError(
            f'{path.name} was trained at {commander.control_hz:g} Hz; the robot runs at '
            f'{status.control_hz:g} Hz'
        )
    zeros = {
        'observation': np.zeros(spec.observation_size),
        'achieved_goal': np.zeros(spec.goal.size),
        'desired_goal': np.zeros(spec.goal.size),
    }
    for _ in range(_WARM_UP_CALLS):
        commander.command(zeros)
    loaded: Commander = commander
    return loaded


def _actor_path(name_or_path: str) -> Path:
    """Does without torch for a file that does."""
    path = Path(name_or_path)
    if path.suffix == '.onnx' and path.is_file():
        return path
    from policy_node.policies.actor import actor_path

    return actor_path(name_or_path)


def _commander_class(path: Path) -> Any:
    if path.suffix == '.onnx':
        from policy_node.policies.onnx import OnnxCommander

        return OnnxCommander
    if path.suffix == '.zip':
        from policy_node.policies.stable_baselines3 import StableBaselines3Commander

        return StableBaselines3Commander
    return ActorCommander


def _sha256(path: Path) -> str:
    with path.open('rb') as file:
        return hashlib.file_digest(file, 'sha256').hexdigest()
