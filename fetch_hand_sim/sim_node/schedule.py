"""Compute when ticks are due, and publish the topic `latest_tick` at a limited rate."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Literal

from msgs_spec.tick import Tick, TickEncoder, join_messages
from msgs_spec.topics import LATEST_TICKS_PER_SECOND, TopicSpec

if TYPE_CHECKING:
    from rclpy.publisher import Publisher

Mode = Literal['realtime', 'lockstep']
Messages = Sequence[tuple[TopicSpec, bytes]]

_PERIOD = 1.0 / LATEST_TICKS_PER_SECOND


class TickSchedule:
    """Computes when ticks are due. Times are seconds of any steady clock.

    Args:
        mode: `realtime` runs ticks at fixed times, `lockstep` one tick per command.
        tick_duration: Simulated seconds per tick.
        real_time_factor: Simulated seconds per second; 0 is as fast as possible.
        now: Present time, at which the first tick is due.

    Attributes:
        changes: Number of pauses, resumptions and changes of the pace.
        missed_ticks: Deadlines that passed without a tick.
        answer_wait: Longest time, s, by which a tick waits for a command to answer the last one.
    """

    def __init__(
        self,
        mode: Mode,
        tick_duration: float,
        real_time_factor: float,
        now: float,
        answer_wait: float = 0.0,
    ) -> None:
        self.mode = mode
        self.answer_wait = answer_wait
        self.is_paused = False
        self.changes = 0
        self.missed_ticks = 0
        self._tick_duration = tick_duration
        self._factor = real_time_factor
        self._due = now
        self._began = -math.inf

    @property
    def period(self) -> float:
        """Wall-clock seconds between ticks in real time; 0 for as fast as possible."""
        return self._tick_duration / self._factor if self._factor else 0.0

    @property
    def waits_for_commands(self) -> bool:
        """True if the next tick needs a command."""
        return self.mode == 'lockstep' and not self.is_paused

    @property
    def asked_rate(self) -> float | None:
        """Requested ticks per wall-clock second; None in lockstep, paused or without a limit."""
        is_paced = self.period and self.mode == 'realtime' and not self.is_paused
        return 1.0 / self.period if is_paced else None

    def wait(self, now: float, has_command: bool, lacks_answer: bool = False) -> float:
        """Return the seconds until the next tick; infinity while paused.

        In lockstep, return 0 with a new command (`has_command`), and infinity without one. In real
        time, add `answer_wait` if `lacks_answer`: no command for the last tick has arrived yet.
        """
        if self.is_paused or (self.mode == 'lockstep' and not has_command):
            return math.inf
        if self.mode == 'lockstep':
            return 0.0
        due = self._due if self._factor else self._began
        return max(0.0, due + (self.answer_wait if lacks_answer else 0.0) - now)

    def postpone(self, until: float) -> None:
        """Move the deadline of the next tick to the time `until`, but by at most `answer_wait`.

        An earlier `until` changes nothing. All later deadlines move, too. Call it before `begin`.
        """
        self._due = min(max(self._due, until), self._due + self.answer_wait)

    def begin(self, now: float) -> None:
        """Set the deadline of the next tick; call it when a tick begins.

        Missed deadlines are counted and skipped, so the robot never runs faster to catch up.
        """
        if self.mode != 'realtime' or self.is_paused:
            return
        self._began = now
        self._due += self.period
        if self.period and self._due <= now:
            missed = int((now - self._due) / self.period) + 1
            self.missed_ticks += missed
            self._due += missed * self.period

    def set_paused(self, paused: bool, now: float) -> None:
        """Pause or resume; ticks of the pause are not caught up."""
        self.is_paused = paused
        self.changes += 1
        self.restart(now)

    def set_real_time_factor(self, factor: float, now: float) -> None:
        """Set the simulated seconds per second; deadlines follow the new pace from `now` on."""
        self._factor = factor
        self.changes += 1
        self.restart(now)

    def restart(self, now: float) -> None:
        """Make the next tick due now, but at least one period after the last tick."""
        self._due = max(now, self._began + self.period)


class LatestTick:
    """Publishes all messages of the newest tick on `latest_tick`, at most 30 times a second."""

    def __init__(
        self, output: Publisher, encoder: TickEncoder, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._output = output
        self._encoder = encoder
        self._clock = clock
        self._due = 0.0
        self._latest: tuple[Tick, Messages] | None = None
        self._is_published = False

    def take(self, tick: Tick, messages: Messages) -> None:
        """Store a tick with its messages, and publish it if the rate allows."""
        self._latest, self._is_published = (tick, messages), False
        self.publish_when_due()

    def repeat(self) -> None:
        """Let `publish_when_due` publish the last tick once more, for new subscribers."""
        self._is_published = False

    def publish_when_due(self) -> None:
        """Publish the newest tick if it is unpublished, has subscribers, and the rate allows."""
        now = self._clock()
        if self._latest is None or self._is_published or now < self._due:
            return
        # A late tick does not delay the next one.
        self._due = max(self._due, now - _PERIOD) + _PERIOD
        if self._output.get_subscription_count() == 0:
            return
        self._is_published = True
        (tick, messages), status = self._latest, []
        if all(spec.name != 'episode_status' for spec, _ in messages):
            status = [self._encoder.encode_status(tick.stamp_ns, tick.status)]
        self._output.publish(join_messages([*messages, *status]))
