"""Message classes, quality of service and the graph, as the nodes take them from rclpy."""

from __future__ import annotations

import time
from collections.abc import Iterable
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, Any

from msgs_spec.topics import QosSpec

if TYPE_CHECKING:
    from rclpy.clock import Clock
    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile

# Seconds for what was said last to be heard.
_LAST_WORDS_SECONDS = 1.0
# Seconds within which discovery has found all nodes that are there.
DISCOVERY_TIME = 2.0
# Seconds after which the graph has forgotten a process that was killed: until then it may stand
# beside its successor. DDS implementations take 20 s or less.
MEMORY_OF_THE_GRAPH = 25.0


def seldom(seconds: float) -> dict[str, Any]:
    """Arguments of a logger for a line that it says at most once in so many seconds.

    By rclpy's default, the system's clock, one that is set back would silence the line until that
    time comes again.
    """
    return {'throttle_duration_sec': seconds, 'throttle_time_source_type': _steady_clock()}


@cache
def _steady_clock() -> Clock:
    """Always the same: a logger takes no other for a line that it has said before."""
    from rclpy.clock import Clock
    from rclpy.clock_type import ClockType

    return Clock(clock_type=ClockType.STEADY_TIME)


def ros_message_class(type_name: str) -> Any:
    """Returns rclpy's class of a message type such as `sensor_msgs/msg/JointState`."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


def ros_service_class(type_name: str) -> Any:
    """Returns rclpy's class of a service type such as `std_srvs/srv/Trigger`."""
    return ros_message_class(type_name)


def rclpy_profile(spec: QosSpec) -> QoSProfile:
    """Returns the profile for rclpy's `create_publisher` and `create_subscription`."""
    from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=spec.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(spec.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(spec.durability),
    )


def full_name(namespace: str, name: str) -> str:
    """Returns the full name of a node in a namespace, such as `/left/sim_node`."""
    return f'{namespace.rstrip("/")}/{name}'


def count_publishers(node: Node, topic: str) -> int:
    """Returns how many publish a topic, under the name to which this node's is remapped."""
    return int(node.count_publishers(node.resolve_topic_name(topic)))


def await_acknowledgements(publishers: Iterable[Publisher]) -> None:
    """Gives what was said last a second to be heard; a killed subscriber never acknowledges."""
    from rclpy.duration import Duration

    deadline = time.monotonic() + _LAST_WORDS_SECONDS
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))
