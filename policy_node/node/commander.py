"""A policy whose actions become commands of a robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.robots import command_from_action
from msgs_spec.tasks import task_spec
from policy_node.policies.policy import LoadedPolicy

Observation = dict[str, NDArray[np.float64]]


class Commander:
    """Turn observations into commands for one robot.

    Args:
        loaded: The policy.
        control_hz: Action frequency of the robot, Hz.

    Attributes:
        spec: Specification of the task.
        description: Format and file name of the policy.
        sha256: SHA-256 of its file; empty without a file.

    Raises:
        ValueError: If the policy was trained at another frequency.
    """

    def __init__(self, loaded: LoadedPolicy, control_hz: float) -> None:
        if loaded.control_hz not in (None, control_hz):
            raise ValueError(
                f'{loaded.description} was trained at {loaded.control_hz:g} Hz; the robot runs at '
                f'{control_hz:g} Hz'
            )
        self.spec = task_spec(loaded.task)
        self.description = loaded.description
        self.sha256 = loaded.sha256
        self._loaded = loaded
        self._state: Any = None

    def start_episode(self) -> None:
        """Reset the memory of the policy."""
        self._state = None

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Return the command (action size,), in command units, for one observation.

        Raises:
            PolicyError: If the policy fails or returns an invalid action.
        """
        action, self._state = self._loaded.predict(observation, self._state)
        command = command_from_action(self.spec.robot, action.astype(np.float64))
        return np.asarray(command, dtype=np.float64)
