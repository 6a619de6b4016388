"""What the ROS graph shows a robot: who commands it, who else is like it, who hears it."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import TYPE_CHECKING

from fetch_hand_sim.sim_node.commanders import CommanderWatch, Endpoint
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topics
from node_runtime.ros import SubscriberWatch, count_publishers, full_name

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher


class GraphWatch:
    """Takes in what the graph shows when asked to.

    Args:
        node: The robot's.
        spec: Its task.
        publishers: Its publishers by topic.

    Attributes:
        commanders: Who publishes commands.
        clock_publishers: Other nodes that publish `/clock`, each name once.
        robots: Nodes that publish the state of a robot under this one's topics, itself included.
        has_newcomer: Whether a commander or listener came since this was last set to False.
    """

    def __init__(self, node: Node, spec: TaskSpec, publishers: Mapping[str, Publisher]) -> None:
        self._node = node
        self._command_topics = {
            node.resolve_topic_name(each.name): each.type_name
            for each in topics(spec)
            if each.direction == 'subscribed' and each.name.endswith('commands')
        }
        self.commanders = CommanderWatch(self._command_topics)
        self.clock_publishers: list[str] = []
        self.robots: list[str] = []
        self.has_newcomer = False
        self._listeners = SubscriberWatch(node, publishers.values())
        self._status = node.resolve_topic_name('episode_status')

    def update(self) -> None:
        """Takes in what the graph shows now."""
        now = time.monotonic()
        found = [each for topic in self._command_topics for each in self._found(topic)]
        if self.commanders.update(found, now):
            self.has_newcomer = True
            self._listeners.expect_more()
        me = self._node.get_fully_qualified_name()
        self.clock_publishers = sorted({each.node for each in self._found('/clock')} - {me})
        self.robots = sorted(each.node for each in self._found(self._status))
        self.has_newcomer |= self._listeners.update()

    def is_heard(self) -> bool:
        """Whether everybody who subscribes is connected: only then a message reaches them."""
        self.has_newcomer |= self._listeners.update()
        return self._listeners.are_connected()

    def waiting_elsewhere(self) -> list[str]:
        """Policies that wait for a robot in another namespace than this one's."""
        return [
            f'{full_name(info.node_namespace, info.node_name)} waits for a robot on {name}'
            for name, _ in self._node.get_topic_names_and_types()
            if name.endswith('/episode_status') and name != self._status
            if not self._node.count_publishers(name)
            for info in self._node.get_subscriptions_info_by_topic(name)
        ]

    def will_introduce(self) -> bool:
        """Whether somebody publishes `policy_status`."""
        return count_publishers(self._node, 'policy_status') > 0

    def _found(self, topic_name: str) -> list[Endpoint]:
        return [
            Endpoint(
                node=full_name(info.node_namespace, info.node_name),
                topic=topic_name,
                type_name=info.topic_type,
                is_reliable=info.qos_profile.reliability.name != 'BEST_EFFORT',
                gid=bytes(info.endpoint_gid),
            )
            for info in self._node.get_publishers_info_by_topic(topic_name)
        ]
