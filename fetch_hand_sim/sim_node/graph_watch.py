"""What the ROS graph shows a robot: who commands it, who else publishes time, who hears it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from fetch_hand_sim.sim_node.commanders import CommanderWatch, Endpoint
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topics

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher

# Seconds without news after which a node's subscriptions count as known: publishers and
# subscriptions are discovered apart, in any order.
_SETTLING_TIME = 0.2


class GraphWatch:
    """Looks at the graph when asked to.

    Attributes:
        commanders: Who publishes commands.
        clock_publishers: Nodes that publish `/clock`.
        has_newcomer: Whether a commander came since this was last set to False.
    """

    def __init__(self, node: Node, spec: TaskSpec) -> None:
        """Looks at nothing yet."""
        self._node = node
        self._topics = {
            node.resolve_topic_name(topic.name): topic.type_name
            for topic in topics(spec)
            if topic.direction == 'subscribed' and topic.name.endswith('commands')
        }
        self.commanders = CommanderWatch(self._topics)
        self.clock_publishers: list[str] = []
        self.has_newcomer = False
        self._subscribers: list[int] = []
        self._changed_at = 0.0

    def look(self) -> None:
        """Takes in what the graph shows now."""
        found = [endpoint for topic in self._topics for endpoint in self._publishers(topic)]
        if self.commanders.look(found):
            self.has_newcomer = True
            self._changed_at = time.monotonic()
        self.clock_publishers = sorted(each.node for each in self._publishers('/clock'))

    def is_heard(self, publishers: Mapping[str, Publisher]) -> bool:
        """Whether everybody who subscribes is connected: only then a message reaches them."""
        known = [self._node.count_subscribers(each.topic_name) for each in publishers.values()]
        now = time.monotonic()
        if known != self._subscribers:
            self._subscribers, self._changed_at = known, now
        if now - self._changed_at < _SETTLING_TIME:
            return False
        connected = (each.get_subscription_count() for each in publishers.values())
        return all(have >= want for have, want in zip(connected, known, strict=True))

    def will_introduce(self) -> bool:
        """Whether somebody publishes `policy_status`."""
        return bool(self._node.count_publishers('policy_status'))

    def _publishers(self, topic: str) -> list[Endpoint]:
        return [
            Endpoint(
                node=f'{info.node_namespace.rstrip("/")}/{info.node_name}',
                topic=topic,
                type_name=info.topic_type,
                is_reliable=info.qos_profile.reliability.name != 'BEST_EFFORT',
                gid=bytes(info.endpoint_gid),
            )
            for info in self._node.get_publishers_info_by_topic(topic)
        ]
