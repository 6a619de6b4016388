"""What the ROS graph shows a robot: who commands it, who else publishes time, who hears it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from fetch_hand_sim.sim_node.commanders import CommanderWatch, Endpoint
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topics

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher


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

    def look(self) -> None:
        """Takes in what the graph shows now."""
        found = [endpoint for topic in self._topics for endpoint in self._publishers(topic)]
        self.has_newcomer |= self.commanders.look(found)
        self.clock_publishers = sorted(each.node for each in self._publishers('/clock'))

    def is_heard(self, publishers: Mapping[str, Publisher]) -> bool:
        """Whether everybody seen to subscribe is connected: only then a message reaches them."""
        return all(
            publisher.get_subscription_count() >= self._node.count_subscribers(publisher.topic_name)
            for publisher in publishers.values()
        )

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
