"""Who answers a robot: a trained actor, or a random or resting one where there is none."""

from __future__ import annotations

import zlib
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from msgs_spec.commands import command_from_action
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
    """A trained actor on one thread, warmed up."""

    def __init__(self, name_or_path: str, status: EpisodeStatus) -> None:
        """Loads a checkpoint.

        Raises:
            ValueError: If it does not fit the robot's task or rate.
        """
        import torch

        from policy_node import checkpoint
        from policy_node.actor import actor_path

        torch.set_num_threads(1)
        path = actor_path(name_or_path)
        self._actor, info = checkpoint.load(path, status.task)
        if info.control_hz != status.control_hz:
            raise ValueError(
                f'{path.name} was trained at {info.control_hz:g} Hz; the robot runs at '
                f'{status.control_hz:g} Hz'
            )
        self.spec = task_spec(info.task)
        self.description = f'actor {path.name}'
        self.sha256 = checkpoint.checkpoint_hash(path)
        for _ in range(_WARM_UP_CALLS):
            self.command(
                {
                    'observation': np.zeros(self.spec.observation_size),
                    'desired_goal': np.zeros(self.spec.goal.size),
                }
            )

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the actor's command."""
        action, _ = self._actor.predict(observation, deterministic=True)
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)


def make_commander(checkpoint: str, status: EpisodeStatus) -> Commander:
    """Makes the commander that a robot gets.

    Args:
        checkpoint: Name of a shipped actor, path of a checkpoint, `random`, `resting`, or '' for
        the
            shipped actor of the robot's task.
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
    return ActorCommander(checkpoint, status)


def _shipped_commander(status: EpisodeStatus) -> Commander:
    from policy_node.actor import shipped_actors

    shipped = shipped_actors()
    if status.task not in shipped:
        raise ValueError(
            f'no actor is shipped for {status.task} (shipped: {", ".join(shipped) or "none"}); '
            f'give a checkpoint, or {RANDOM!r} or {RESTING!r}'
        )
    return ActorCommander(status.task, status)
