"""The newest valid command of a robot.

Rules as in ros2_control's forward_command_controller: Commands of a wrong size, or with values that
are not finite, are rejected and counted. Values out of range are clipped. The robot rests before
the first valid command, and holds its position if no command arrives within the timeout.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NoReturn

import numpy as np
from numpy.typing import ArrayLike

from msgs_spec.arrays import Array
from msgs_spec.robots import RobotSpec, clip_command, command_limits

# Characters of a received name in an error line.
_NAME_SHOWN = 40
# Multiple of the range beyond a limit that a controller does not overshoot by.
_FAR = 2.0


class CommandBuffer:
    """Checks and stores the newest command of one robot.

    The robot holds its position after `timeout` wall-clock seconds without a command; 0: never.

    Attributes:
        far_out: Number of commands that were beyond a limit by more than twice the range.
        last_far_out: Description of the last such value and its limits; '' if there was none.
        last_rejection: Why the last rejected command was rejected; '' before.
        is_last_rejected: Whether the last command was rejected.
        has_fresh_command: Whether a command arrived since the last `take` or `start_episode`.
        answered_stamp: Stamp of the observation from which the last command was computed,
            nanoseconds; None if the command names none.
    """

    def __init__(
        self, robot: RobotSpec, timeout: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._robot = robot
        self._names = [part.name for part in robot.command]
        self._lower, self._upper = command_limits(robot)
        self.timeout = timeout
        self.accepted = 0
        self.clipped = 0
        self.far_out = 0
        self.rejected: Counter[str] = Counter()
        self.last_far_out = ''
        self.last_rejection = ''
        self.is_last_rejected = False
        self._clock = clock
        self._resting = np.zeros(robot.action_size)
        self._command: Array | None = None
        self._received_at: float | None = None
        self.has_fresh_command = False
        self.answered_stamp: int | None = None

    @property
    def has_command(self) -> bool:
        """True if a valid command arrived in this episode."""
        return self._command is not None

    def age(self) -> float | None:
        """Return the wall-clock seconds since the last valid command of any episode, or None."""
        return None if self._received_at is None else self._clock() - self._received_at

    def start_episode(self, resting_command: ArrayLike) -> None:
        """Drop the last command, because an episode starts.

        Args:
            resting_command: (action size,), the command until the first one arrives. Joints that
                `accept_named` does not name keep these values, if no command came before.
        """
        self._resting = np.array(resting_command, dtype=np.float64)
        self._command = None
        self.has_fresh_command = False

    def accept(self, values: ArrayLike, answered_stamp: int | None = None) -> None:
        """Store a command, clipped to the limits; ValueError for a wrong size or non-finite value.

        Args:
            values: (action size,) in the order of the robot's commands, command units.
            answered_stamp: Stamp of the observation from which the command was computed, ns.
        """
        command = np.asarray(values, dtype=np.float64).ravel()
        size = self._robot.action_size
        if command.size != size:
            self._reject('wrong size', f'{command.size} values given; allowed: {size}')
        self._store(command, answered_stamp)

    def accept_named(self, names: Sequence[str], positions: ArrayLike) -> None:
        """Store targets, in command units, of the joints `names`; the other targets stay.

        Unknown or repeated names, wrong sizes and values that are not finite raise ValueError.
        """
        values = np.asarray(positions, dtype=np.float64).ravel()
        if len(names) != values.size:
            self._reject('wrong size', f'{len(names)} names but {values.size} positions given')
        unknown = [name for name in names if name not in self._names]
        if unknown:
            self._reject(
                'unknown joint',
                f'joint {unknown[0][:_NAME_SHOWN]!r} given; allowed: {", ".join(self._names)}',
            )
        if len(set(names)) != len(names):
            self._reject('repeated joint', 'a joint is named twice')
        if not names:
            self._reject('wrong size', 'no joint is named')
        command = (self._resting if self._command is None else self._command).copy()
        command[[self._names.index(name) for name in names]] = values
        self._store(command)

    def count_rejection(self, reason: str, line: str) -> None:
        """Count a rejected message under the key `reason`; `last_rejection` becomes `line`."""
        self.rejected[reason] += 1
        self.last_rejection = line
        self.is_last_rejected = True

    def take(self) -> Array:
        """Return the command of the next tick, (action size,), command units, within limits.

        The resting command applies before the first command of the episode. After `timeout` seconds
        without a new command, the arm stops; grip and joint targets stay. A command that arrived
        since the last tick always applies, even if it is older than `timeout`.
        """
        is_fresh, self.has_fresh_command = self.has_fresh_command, False
        if self._command is None:
            return self._resting
        is_late = not is_fresh and 0.0 < self.timeout < (self.age() or 0.0)
        return self._holding(self._command) if is_late else self._command

    def _holding(self, command: Array) -> Array:
        """Return `command` changed so that the arm stops; grip and joint targets stay."""
        if not self._robot.has_gripper_command:
            return command
        keeps = [part.name == 'gripper' for part in self._robot.command]
        return np.where(keeps, command, self._resting)

    def _store(self, command: Array, answered_stamp: int | None = None) -> None:
        finite = np.isfinite(command)
        if not finite.all():
            index = int(np.argmin(finite))
            line = f'{self._names[index]} is {command[index]}; allowed: finite numbers'
            self._reject('not finite', line)
        self._command = clip_command(self._robot, command)
        if not np.array_equal(command, self._command):
            self._count_clipping(command)
        self._received_at = self._clock()
        self.has_fresh_command = True
        self.answered_stamp = answered_stamp
        self.accepted += 1
        self.is_last_rejected = False

    def _count_clipping(self, command: Array) -> None:
        self.clipped += 1
        lower, upper = self._lower, self._upper
        beyond = np.maximum(lower - command, command - upper) - _FAR * (upper - lower)
        index = int(beyond.argmax())
        if beyond[index] > 0.0:
            self.far_out += 1
            part = self._robot.command[index]
            self.last_far_out = (
                f'{part.name} is {command[index]:g}; allowed: {part.lower:.4g} ... '
                f'{part.upper:.4g} {part.unit}'
            )

    def _reject(self, reason: str, line: str) -> NoReturn:
        self.count_rejection(reason, line)
        raise ValueError(line)
