"""Real-time pacing on a steady clock: fixed deadlines, late ticks counted and never made up for."""

from __future__ import annotations

import math


class RealTimePacer:
    """Says when the next tick is due. Times are seconds of any steady clock.

    The first tick is due at once.

    Args:
        tick_duration: Simulated seconds per tick.
        real_time_factor: Simulated seconds per second; 0 is as fast as possible.
        now: The time now.

    Attributes:
        real_time_factor: As given; may be set at any time.
        missed_ticks: Deadlines that passed without a tick.
    """

    def __init__(self, tick_duration: float, real_time_factor: float, now: float) -> None:
        self._tick_duration = tick_duration
        self._due = now
        self._began = -math.inf
        self.missed_ticks = 0
        self.real_time_factor = real_time_factor

    @property
    def period(self) -> float:
        """Seconds between ticks; 0 where the factor is 0."""
        return self._tick_duration / self.real_time_factor if self.real_time_factor else 0.0

    def remaining(self, now: float) -> float:
        """Seconds until the next tick is due; 0 or less when it is."""
        return self._due - now if self.real_time_factor else 0.0

    def advance(self, now: float) -> None:
        """Notes that the due tick has begun and sets the next deadline.

        A tick that comes a whole period late or more has missed deadlines: they are counted and
        skipped, so the robot never runs faster than asked to catch up.
        """
        period = self.period
        self._began = now
        self._due += period
        if period and self._due <= now:
            missed = int((now - self._due) / period) + 1
            self.missed_ticks += missed
            self._due += missed * period

    def restart(self, now: float) -> None:
        """Makes the next tick due now, after a pause; not sooner than a period after the last."""
        self._due = max(now, self._began + self.period)
