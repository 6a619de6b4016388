"""Whether everybody who subscribes to a node is connected: only then a message reaches them."""

from __future__ import annotations

import time
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher

# Seconds without news after which a node's subscriptions count as known: publishers and
# subscriptions are discovered apart, in any order.
_SETTLING_TIME = 0.2
# Seconds without news after which who is not connected will never be: it asks for another quality
# of service than is offered. A busy machine has taken three.
_PATIENCE = 6.0


class Listeners:
    """Counts who subscribes to topics of a node, and who of them is connected.

    Args:
        node: Whose publishers.
        publishers: Of the topics.
    """

    def __init__(self, node: Node, publishers: Iterable[Publisher]) -> None:
        self._node = node
        self._publishers = tuple(publishers)
        self._counts = [0 for _ in self._publishers]
        self._changed_at = 0.0

    def expect_more(self) -> None:
        """Takes in that a node has appeared, whose subscriptions may be unknown yet."""
        self._changed_at = time.monotonic()

    def update(self) -> bool:
        """Takes in what the graph shows now; returns whether somebody came."""
        before = self._counts
        self._counts = [self._node.count_subscribers(each.topic_name) for each in self._publishers]
        if self._counts != before:
            self.expect_more()
        return any(have > had for have, had in zip(self._counts, before, strict=True))

    def are_connected(self) -> bool:
        """Whether all are that can be, and nothing has changed for a while."""
        quiet_for = time.monotonic() - self._changed_at
        if quiet_for > _PATIENCE:
            return True
        connected = (each.get_subscription_count() for each in self._publishers)
        pairs = zip(connected, self._counts, strict=True)
        return quiet_for >= _SETTLING_TIME and all(have >= want for have, want in pairs)
