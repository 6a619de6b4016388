"""When the next tick is due: by the clock, by a command, or by a step while paused."""

from __future__ import annotations

import math
from typing import Literal

from fetch_hand_sim.sim_node.pacing import RealTimePacer

Mode = Literal['realtime', 'lockstep']


class TickSchedule:
    """Decides, and never looks at a clock itself. Times are seconds of any steady one.

    Args:
        mode: `realtime` follows the pacer, `lockstep` the commands.
        pacer: With its first tick due at the start.

    Attributes:
        mode: As above.
        pacer: As above.
        is_paused: Whether there are no ticks.
        changes: How often it was paused, told to go on, or given a pace.
    """

    def __init__(self, mode: Mode, pacer: RealTimePacer) -> None:
        self.mode = mode
        self.pacer = pacer
        self.is_paused = False
        self.changes = 0

    @property
    def waits_for_commands(self) -> bool:
        """Whether only a command brings the next tick."""
        return self.mode == 'lockstep' and not self.is_paused

    @property
    def asked_rate(self) -> float | None:
        """Ticks per second of wall time asked for; None where none are."""
        period = self.pacer.period
        return 1.0 / period if period and self.mode == 'realtime' and not self.is_paused else None

    def wait(self, now: float, has_command: bool) -> float:
        """Seconds until the next tick is due: 0 now, infinity when something has to happen first.

        Args:
            now: The time now.
            has_command: Whether a command waits to be applied, or none is needed.
        """
        if self.is_paused:
            return math.inf
        if self.mode == 'lockstep':
            return 0.0 if has_command else math.inf
        return max(0.0, self.pacer.remaining(now))

    def begin(self, now: float) -> None:
        """Notes that a due tick begins."""
        if self.mode == 'realtime' and not self.is_paused:
            self.pacer.advance(now)

    def set_paused(self, paused: bool, now: float) -> None:
        """Pauses or goes on; what was missed meanwhile is not made up for."""
        self.is_paused = paused
        self.changes += 1
        self.pacer.restart(now)

    def set_real_time_factor(self, factor: float, now: float) -> None:
        """Changes the pace from now on."""
        self.pacer.real_time_factor = factor
        self.changes += 1
        self.pacer.restart(now)
