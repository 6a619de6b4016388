"""Holds the latest valid command and says what the next tick applies.

Habits of ros2_control's forward_command_controller: a command of the wrong size or with a value
that is not finite is dropped and counted, out of range is clipped, nothing is applied before the
first valid one, and when commands stop for longer than the timeout the robot holds.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.commands import clip_command
from msgs_spec.robots import RobotSpec

Array = NDArray[np.float64]
Source = Literal['rest', 'command', 'hold']
# Characters of a received name that an error line repeats.
_NAME_SHOWN = 40


class CommandRejected(ValueError):
    """A received command is not valid.

    Attributes:
        reason: Short, for counting: `wrong size`, `not finite`, `unknown joint`, ...
    """

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class NextCommand:
    """What the next tick applies.

    Attributes:
        values: (action size,), command units, within limits.
        source: `command`: received in time; `rest`: none came yet in this episode; `hold`: the last
            one is older than the timeout.
    """

    values: Array
    source: Source


class CommandBuffer:
    """The latest valid command of one robot.

    Times are seconds of any steady clock.

    Attributes:
        timeout: Seconds after which the last command is replaced by holding; 0 never.
        accepted: Valid commands so far.
        rejected: Others, by reason.
        last_rejection: Why the last command was rejected; empty if it was not.
    """

    def __init__(self, robot: RobotSpec, timeout: float) -> None:
        """Starts empty.

        Args:
            robot: Whose commands.
            timeout: Seconds after which the last command is replaced by holding; 0 never.
        """
        self._robot = robot
        self._names = [part.name for part in robot.command]
        self.timeout = timeout
        self.accepted = 0
        self.rejected: Counter[str] = Counter()
        self.last_rejection = ''
        self._resting = np.zeros(robot.action_size)
        self._command: Array | None = None
        self._received_at = 0.0
        self._is_fresh = False

    @property
    def has_fresh_command(self) -> bool:
        """Whether a command came since the last `take` or `start_episode`."""
        return self._is_fresh

    def age(self, now: float) -> float | None:
        """Seconds since the last valid command of this episode, or None if none came."""
        return None if self._command is None else now - self._received_at

    def start_episode(self, resting_command: ArrayLike) -> None:
        """Forgets the command.

        Args:
            resting_command: (action size,): what applies until one comes, and the base of commands
                that name only some joints.
        """
        self._resting = np.array(resting_command, dtype=np.float64)
        self._command = None
        self._is_fresh = False

    def accept(self, values: ArrayLike, now: float) -> None:
        """Takes a whole command, in order.

        Raises:
            CommandRejected: If its size is wrong or a value is not finite; the buffer is unchanged.
        """
        command = np.asarray(values, dtype=np.float64).ravel()
        size = self._robot.action_size
        if command.size != size:
            self._reject('wrong size', f'command of {command.size} values dropped; allowed: {size}')
        self._store(command, now)

    def accept_named(self, names: Sequence[str], positions: ArrayLike, now: float) -> None:
        """Takes joint positions by name, in any order; joints not named keep their target.

        Raises:
            CommandRejected: If names and positions do not match, a name is unknown or given twice,
                or a value is not finite; the buffer is unchanged.
        """
        values = np.asarray(positions, dtype=np.float64).ravel()
        if len(names) != values.size:
            self._reject(
                'wrong size',
                f'joint command dropped: {len(names)} names but {values.size} positions',
            )
        unknown = [name for name in names if name not in self._names]
        if unknown:
            self._reject(
                'unknown joint',
                f'joint command dropped: unknown joint {unknown[0][:_NAME_SHOWN]!r}; allowed: '
                f'{", ".join(self._names)}',
            )
        if len(set(names)) != len(names):
            self._reject('repeated joint', 'joint command dropped: a joint is named twice')
        if not names:
            self._reject('wrong size', 'joint command dropped: it names no joint')
        command = (self._resting if self._command is None else self._command).copy()
        command[[self._names.index(name) for name in names]] = values
        self._store(command, now)

    def take(self, now: float) -> NextCommand:
        """Returns what the next tick applies."""
        self._is_fresh = False
        if self._command is None:
            return NextCommand(self._resting, 'rest')
        if self.timeout > 0.0 and now - self._received_at > self.timeout:
            return NextCommand(self._holding(self._command), 'hold')
        return NextCommand(self._command, 'command')

    def _holding(self, command: Array) -> Array:
        """Keeps the pose: the gripper stops and keeps its grip, joints keep their targets."""
        if not self._robot.has_gripper_command:
            return command
        return np.array([0.0, 0.0, 0.0, command[3]])

    def _store(self, command: Array, now: float) -> None:
        finite = np.isfinite(command)
        if not finite.all():
            index = int(np.argmin(finite))
            self._reject(
                'not finite',
                f'command dropped: {self._names[index]} is {command[index]}; allowed: finite '
                'numbers',
            )
        self._command = clip_command(self._robot, command)
        self._received_at = now
        self._is_fresh = True
        self.accepted += 1
        self.last_rejection = ''

    def _reject(self, reason: str, message: str) -> None:
        self.rejected[reason] += 1
        self.last_rejection = message
        raise CommandRejected(reason, message)
