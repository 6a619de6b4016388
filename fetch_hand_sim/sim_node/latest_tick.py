"""The topic `latest_tick`: all messages of the newest tick in one, at a limited rate."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from fetch_hand_sim.sim_node.robot import Messages
from msgs_spec.tick import Tick, TickEncoder, join_messages
from msgs_spec.topics import LATEST_TICKS_PER_SECOND

_PERIOD = 1.0 / LATEST_TICKS_PER_SECOND


class Output(Protocol):
    """The methods of rclpy's publisher that are needed here."""

    def publish(self, msg: bytes) -> None:
        """Send a message."""

    def get_subscription_count(self) -> int:
        """Return the number of subscribers."""


class LatestTick:
    """Publishes the newest tick while the topic has subscribers.

    Args:
        output: Publisher of the topic.
        encoder: Adds `episode_status` to ticks without it.
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
        self._is_published = False

    def take(self, tick: Tick, messages: Messages) -> None:
        """Store a tick with its messages, and publish it if the rate allows."""
        self._latest, self._is_published = (tick, messages), False
        self.publish_when_due()

    def repeat(self) -> None:
        """Publish the last tick once more, for new subscribers."""
        self._is_published = False

    def publish_when_due(self) -> None:
        """Publish the newest tick if it is unpublished, due, and has subscribers."""
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
