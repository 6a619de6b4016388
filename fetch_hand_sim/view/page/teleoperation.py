"""Commanding by hand: the values of sliders, and what the arrow keys do to them."""

from __future__ import annotations

from msgs_spec.actions import resting_command
from msgs_spec.arrays import Array
from msgs_spec.robots import CommandPart, RobotSpec

# Seconds in which a key that is held moves a slider from end to end.
_SWEEP = 2.0
# Such as 'x 0.05 m': so much in each tick.
_MOVES = 'x '


def is_move(part: CommandPart) -> bool:
    """Whether a command says how far to go in each tick, not where to: it rests at 0."""
    return part.unit.startswith(_MOVES)


class Teleoperation:
    """One command, changed by sliders and keys.

    Args:
        robot: The robot.
        start: (action size,) the command before; None for one at rest.

    Attributes:
        values: (action size,) command units.
        selected: Which part the keys change.
    """

    def __init__(self, robot: RobotSpec, start: Array | None) -> None:
        self._parts = robot.command
        self.values = resting_command(robot) if start is None else start.copy()
        for index, part in enumerate(self._parts):
            if is_move(part):
                self.values[index] = 0.0
        self.selected = 0
        self._held: int | None = None

    def select(self, by: int) -> None:
        """Takes another part, relative to this one."""
        self.selected = (self.selected + by) % len(self._parts)

    def hold(self, direction: int, seconds: float) -> None:
        """Does what a held key asks for; to be called for every frame, also without a key.

        Positions go on slowly and stay; moves are made as fast as they may while the key is held.

        Args:
            direction: -1, 0 (no key) or 1.
            seconds: Since the last call.
        """
        if self._held is not None and (not direction or self._held != self.selected):
            self.values[self._held] = 0.0
            self._held = None
        if not direction:
            return
        part = self._parts[self.selected]
        if is_move(part):
            self._held = self.selected
            self.values[self.selected] = part.upper if direction > 0 else part.lower
            return
        step = direction * (part.upper - part.lower) * seconds / _SWEEP
        value = self.values[self.selected] + step
        self.values[self.selected] = min(max(value, part.lower), part.upper)
