"""A policy whose actions become commands of a robot."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.robots import command_from_action
from msgs_spec.tasks import task_spec
from msgs_spec.text import one_line
from policy_node.policies.policy import LoadedPolicy

Observation = dict[str, NDArray[np.float64]]


class Commander:
    """Turn observations into commands for one robot.

    Args:
        loaded: The policy.
        control_hz: The robot's action frequency, Hz.

    Attributes:
        spec: The task.
        description: Who it is, for people.
        sha256: Fingerprint of its file; empty if it has none.

    Raises:
        ValueError: If the policy was trained at another rate.
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
        """Forget the episode before; a policy without memory has nothing to forget."""
        self._state = None

    def command(self, observation: Observation) -> NDArray[np.float64]:
        """Returns the command (action size,), command units, for one observation.

        Raises:
            ValueError: If the policy fails, or gives something else than finite numbers, as many
                as an action has.
        """
        try:
            action, state = self._loaded.predict(observation, self._state)
            action = np.asarray(action, dtype=np.float64)
        except Exception as error:
            # Libraries raise types of their own, one observation in a thousand may be the cause.
            raise ValueError(f'{self.description} fails: {one_line(error)}') from None
        if not np.isfinite(action).all():
            raise ValueError(f'{self.description} gives a value that is not finite')
        if action.shape != (self.spec.robot.action_size,):
            raise ValueError(
                f'{self.description} gives shape {action.shape}; '
                f'allowed: ({self.spec.robot.action_size},)'
            )
        self._state = state
        return np.asarray(command_from_action(self.spec.robot, action), dtype=np.float64)
