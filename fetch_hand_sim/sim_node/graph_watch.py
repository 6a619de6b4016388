"""Watch the ROS graph of a simulator node: publishers of its inputs, subscribers, other robots."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topics
from node_runtime.ros import MEMORY_OF_THE_GRAPH, SubscriberWatch, count_publishers, full_name

if TYPE_CHECKING:
    from rclpy.node import Node
    from rclpy.publisher import Publisher


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A publisher in the ROS graph; `node` and `topic` are fully qualified names."""

    node: str
    topic: str
    type_name: str
    is_reliable: bool
    gid: bytes


class InputWatch:
    """Stores the publishers of the topics that a robot subscribes to, and finds problems.

    Args:
        types: Message type by topic.
        commands: Topics in `types` that carry commands.
    """

    def __init__(self, types: Mapping[str, str], commands: Sequence[str]) -> None:
        self.types = types
        self._commands = commands
        self._endpoints: list[Endpoint] = []
        self._since: dict[bytes, float] = {}
        self._now = 0.0

    @property
    def commanders(self) -> list[str]:
        """Sorted names of the nodes that command; a name used by two processes occurs twice."""
        copies: dict[str, int] = {}
        for topic in self._commands:
            for node in {endpoint.node for endpoint in self._endpoints}:
                copies[node] = max(copies.get(node, 0), self._copies(node, topic))
        return sorted(name for name, count in copies.items() for _ in range(count))

    def update(self, found: Iterable[Endpoint], now: float) -> bool:
        """Store the publishers found at time `now`, s; return if a publisher of commands is new."""
        known = self._since
        self._endpoints, self._now = list(found), now
        self._since = {each.gid: known.get(each.gid, now) for each in self._endpoints}
        return any(
            each.gid not in known for each in self._endpoints if each.topic in self._commands
        )

    def problems(self) -> list[str]:
        """Return one line for each problem, such as two commanders or a wrong message type."""
        problems, names = [], self.commanders
        if len(names) > 1:
            problems.append(f'{len(names)} publish commands: {", ".join(names)}')
        for endpoint in self._endpoints:
            reason = self._mismatch(endpoint)
            if reason:
                problems.append(f'{endpoint.topic} of {endpoint.node} is not received: {reason}')
        return problems

    def _copies(self, node: str, topic: str) -> int:
        """Return how many processes with the node name `node` publish `topic`.

        A killed process stays in the graph for a while; it and its successor count as one.
        """
        ages = [
            self._now - self._since[each.gid]
            for each in self._endpoints
            if (each.node, each.topic) == (node, topic) and not self._mismatch(each)
        ]
        return len(ages) if ages and min(ages) > MEMORY_OF_THE_GRAPH else min(len(ages), 1)

    def _mismatch(self, endpoint: Endpoint) -> str:
        """Return why the robot cannot receive from a publisher (its type or reliability), or ''."""
        allowed = self.types[endpoint.topic]
        if endpoint.type_name != allowed:
            return f'its type is {endpoint.type_name}; allowed: {allowed}'
        return '' if endpoint.is_reliable else 'it is best effort; allowed: reliable'


class GraphWatch:
    """The state of the ROS graph at the last `update`.

    Attributes:
        inputs: Publishers of the topics that the robot subscribes to.
        clock_publishers: Other nodes that publish `/clock`.
        robots: Nodes that publish `episode_status` in this namespace, this node included.
        has_newcomer: Whether a commander or subscriber is new since this was last set to False.
    """

    def __init__(self, node: Node, spec: TaskSpec, publishers: Mapping[str, Publisher]) -> None:
        self._node = node
        received = {
            node.resolve_topic_name(each.name): each
            for each in topics(spec)
            if each.direction == 'subscribed'
        }
        self.inputs = InputWatch(
            {name: each.type_name for name, each in received.items()},
            [name for name, each in received.items() if each.name.endswith('commands')],
        )
        self.clock_publishers: list[str] = []
        self.robots: list[str] = []
        self.has_newcomer = False
        self._subscribers = SubscriberWatch(node, publishers.values())
        self._status = node.resolve_topic_name('episode_status')

    def update(self) -> None:
        """Read the ROS graph and renew all attributes."""
        found = [each for topic in self.inputs.types for each in self._found(topic)]
        if self.inputs.update(found, time.monotonic()):
            self.has_newcomer = True
            self._subscribers.expect_more()
        me = self._node.get_fully_qualified_name()
        self.clock_publishers = sorted({each.node for each in self._found('/clock')} - {me})
        self.robots = sorted(each.node for each in self._found(self._status))
        self.has_newcomer |= self._subscribers.update()

    def are_subscribers_connected(self) -> bool:
        """Return whether all compatible subscribers of the robot's topics are connected."""
        self.has_newcomer |= self._subscribers.update()
        return self._subscribers.are_connected()

    def waiting_elsewhere(self) -> list[str]:
        """Return a line for each node that waits for a robot in a namespace without a robot."""
        return [
            f'{full_name(info.node_namespace, info.node_name)} waits for a robot on {name}'
            for name, _ in self._node.get_topic_names_and_types()
            if name.endswith('/episode_status') and name != self._status
            if not self._node.count_publishers(name)
            for info in self._node.get_subscriptions_info_by_topic(name)
        ]

    def has_policy_status(self) -> bool:
        """Return whether a policy publishes `policy_status`."""
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
