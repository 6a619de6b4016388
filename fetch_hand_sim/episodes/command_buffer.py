"""The newest valid command of a robot.

As ros2_control's forward_command_controller does: commands of a wrong size or with values that are
not finite are dropped and counted, values out of range are clipped, nothing is applied before the
first valid command, and after the timeout the robot holds.
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
    """The newest valid command of one robot.

    The robot holds after `timeout` seconds without a command; 0 means never.

    Attributes:
        far_out: Clipped commands far out of range, probably in another unit.
        last_far_out: The value far out of range and its limits.
        last_rejection: Why the last command was rejected; empty if it was valid.
        has_fresh_command: Whether a command came since the last `take` or `start_episode`.
        answered_stamp: Stamp of the observation that the last command answers, nanoseconds; None
            if it names none.
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
        self._clock = clock
        self._resting = np.zeros(robot.action_size)
        self._command: Array | None = None
        self._received_at: float | None = None
        self.has_fresh_command = False
        self.answered_stamp: int | None = None

    @property
    def has_command(self) -> bool:
        """True if a valid command came in this episode."""
        return self._command is not None

    def age(self) -> float | None:
        """Return the seconds since the last valid command of any episode, or None."""
        return None if self._received_at is None else self._clock() - self._received_at

    def start_episode(self, resting_command: ArrayLike) -> None:
        """Drop the last command, because an episode starts.

        Args:
            resting_command: (action size,): applies until the first command, and is the base of
                commands that name only some joints.
        """
        self._resting = np.array(resting_command, dtype=np.float64)
        self._command = None
        self.has_fresh_command = False

    def accept(self, values: ArrayLike, answered_stamp: int | None = None) -> None:
        """Store a whole command, in order, or raise ValueError and change nothing.

        Args:
            values: (action size,).
            answered_stamp: Stamp of the observation that it answers, nanoseconds, if known.
        """
        command = np.asarray(values, dtype=np.float64).ravel()
        size = self._robot.action_size
        if command.size != size:
            self._reject('wrong size', f'{command.size} values given; allowed: {size}')
        self._store(command, answered_stamp)

    def accept_named(self, names: Sequence[str], positions: ArrayLike) -> None:
        """Store joint positions by name, or raise ValueError; other joints keep their target."""
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
        """Count an unusable message, by its short `reason`; `line` describes it in full."""
        self.rejected[reason] += 1
        self.last_rejection = line

    def take(self) -> Array:
        """Return the command of the next tick, (action size,), command units, within limits.

        Without a command in this episode it is the resting command. After `timeout` seconds without
        a new one it is the command that holds. A command that came since the last tick always
        applies, however slow the ticks are.
        """
        is_fresh, self.has_fresh_command = self.has_fresh_command, False
        if self._command is None:
            return self._resting
        is_late = not is_fresh and 0.0 < self.timeout < (self.age() or 0.0)
        return self._holding(self._command) if is_late else self._command

    def _holding(self, command: Array) -> Array:
        """Return the command that holds: the gripper keeps its grip, joints keep their targets."""
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
        self.last_rejection = ''

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
