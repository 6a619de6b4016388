"""Says the latest tick to those who only look, as often as is worth looking at."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from fetch_hand_sim.sim_node.robot import Messages
from msgs_spec.latest_tick import join_messages
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import LATEST_TICKS_PER_SECOND

_PERIOD = 1.0 / LATEST_TICKS_PER_SECOND


class Output(Protocol):
    """What is needed of a publisher of rclpy."""

    def publish(self, msg: bytes) -> None:
        """Sends a message."""

    def get_subscription_count(self) -> int:
        """How many hear it."""


class LatestTick:
    """Publishes the messages of the latest tick in one, while somebody subscribes.

    Args:
        output: Of the topic.
        encoder: Adds `episode_status` where a tick comes without.
        clock: A steady clock, seconds.
    """

    def __init__(
        self, output: Output, encoder: TickEncoder, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._output = output
        self._encoder = encoder
        self._clock = clock
        self._due = 0.0
        self._latest: tuple[Tick, Messages] | None = None
        self._is_said = False

    def take(self, tick: Tick, messages: Messages) -> None:
        """Takes a tick with its messages, and says it if it is time."""
        self._latest, self._is_said = (tick, messages), False
        self.say_when_due()

    def repeat(self) -> None:
        """Has the tick said again, to those who have come since."""
        self._is_said = False

    def say_when_due(self) -> None:
        """Says the latest tick unless it has been, it is too soon, or nobody listens."""
        now = self._clock()
        if self._latest is None or self._is_said or now < self._due:
            return
        # A tick that was late does not hold up the next.
        self._due = max(self._due, now - _PERIOD) + _PERIOD
        if self._output.get_subscription_count() == 0:
            return
        self._is_said = True
        (tick, messages), status = self._latest, []
        if all(spec.name != 'episode_status' for spec, _ in messages):
            status = [self._encoder.encode_status(tick.stamp_ns, tick.status)]
        self._output.publish(join_messages([*messages, *status]))
