"""Helpers for rclpy: message classes, quality of service, discovery and transport."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterable, MutableMapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgs_spec.topics import QosSpec, TopicSpec

if TYPE_CHECKING:
    from rclpy.clock import Clock
    from rclpy.node import Node
    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile
    from rclpy.subscription import Subscription

_UNKNOWN = '_NODE_NAME_UNKNOWN_'
# Seconds to wait at shutdown until subscribers have the last messages.
_LAST_MESSAGES_SECONDS = 1.0
# Seconds within which discovery finds all running nodes.
DISCOVERY_TIME = 2.0
# Seconds for which the graph may still show a killed process beside its successor. DDS
# implementations need 20 s or less.
MEMORY_OF_THE_GRAPH = 25.0
# Seconds without changes after which the subscriptions of a node count as known: publishers and
# subscriptions are discovered separately, in any order.
_SETTLING_TIME = 0.2
# Seconds without changes after which an unconnected subscription counts as incompatible. A busy
# machine has taken three to connect.
_PATIENCE = 6.0


def seldom(seconds: float) -> dict[str, Any]:
    """Return keyword arguments that limit a log call to once in `seconds` of a steady clock.

    With the system clock, rclpy's default, lines would be missing after that clock is set back.
    """
    return {'throttle_duration_sec': seconds, 'throttle_time_source_type': _steady_clock()}


@cache
def _steady_clock() -> Clock:
    """Return the same steady clock in all calls; rclpy forbids a log call to change its clock."""
    from rclpy.clock import Clock
    from rclpy.clock_type import ClockType

    return Clock(clock_type=ClockType.STEADY_TIME)


def ros_message_class(type_name: str) -> Any:
    """Return rclpy's class of a message type such as `sensor_msgs/msg/JointState`."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


def ros_service_class(type_name: str) -> Any:
    """Return rclpy's class of a service type such as `std_srvs/srv/Trigger`."""
    return ros_message_class(type_name)


def rclpy_profile(spec: QosSpec) -> QoSProfile:
    """Return a quality of service as the profile that rclpy's publishers and subscriptions take."""
    from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=spec.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(spec.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(spec.durability),
    )


def open_publisher(node: Node, spec: TopicSpec) -> Publisher:
    """Create a publisher with the name, type and quality of service of a topic."""
    return node.create_publisher(
        ros_message_class(spec.type_name), spec.name, rclpy_profile(spec.qos)
    )


def subscribe(
    node: Node,
    spec: TopicSpec,
    callback: Callable[[Any], None],
    *,
    qos: QosSpec | None = None,
    raw: bool = False,
) -> Subscription:
    """Subscribe to a topic, with the topic's own quality of service unless `qos` is given.

    With `raw`, the callback gets the bytes of each message.
    """
    profile = rclpy_profile(qos or spec.qos)
    return node.create_subscription(
        ros_message_class(spec.type_name), spec.name, callback, profile, raw=raw
    )


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a node in a namespace, such as `/left/sim_node`.

    While discovery does not know the name, the result is `(a node without a name yet)`.
    """
    if name == _UNKNOWN:
        return '(a node without a name yet)'
    return f'{namespace.rstrip("/")}/{name}'


def count_publishers(node: Node, topic: str) -> int:
    """Return the number of publishers of a topic, after the remappings of `node`."""
    return int(node.count_publishers(node.resolve_topic_name(topic)))


def await_acknowledgements(publishers: Iterable[Publisher]) -> None:
    """Wait until reliable subscribers have acknowledged all messages, for a second at most."""
    from rclpy.duration import Duration

    deadline = time.monotonic() + _LAST_MESSAGES_SECONDS
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))


class SubscriberWatch:
    """Tracks whether all discovered subscribers of the given publishers are connected."""

    def __init__(self, node: Node, publishers: Iterable[Publisher]) -> None:
        self._node = node
        self._publishers = tuple(publishers)
        self._counts = [0 for _ in self._publishers]
        self._changed_at = 0.0

    def expect_more(self) -> None:
        """Make `are_connected` return False for 0.2 s, as a new node may soon subscribe."""
        self._changed_at = time.monotonic()

    def update(self) -> bool:
        """Count the subscribers again; return whether a topic has more of them than before."""
        before = self._counts
        self._counts = [self._node.count_subscribers(each.topic_name) for each in self._publishers]
        if self._counts != before:
            self.expect_more()
        return any(have > had for have, had in zip(self._counts, before, strict=True))

    def are_connected(self) -> bool:
        """Return whether the publishers are connected to all subscribers that `update` counted.

        Returns False for 0.2 s after each change of the number of subscribers. After 6 s without
        changes, unconnected subscribers count as incompatible and are ignored.
        """
        quiet_for = time.monotonic() - self._changed_at
        if quiet_for > _PATIENCE:
            return True
        connected = (each.get_subscription_count() for each in self._publishers)
        pairs = zip(connected, self._counts, strict=True)
        return quiet_for >= _SETTLING_TIME and all(have >= want for have, want in pairs)


# Transport
#
# With shared memory, a writer of Fast DDS 2.14 waits up to a second for stopped readers and takes
# locks in their segments. A stopped viewer cost a robot in lockstep a quarter of its ticks
# (`make bench-view`), and killed viewers blocked robots for seconds. UDP avoids both and is as fast
# for messages of a robot's size.

_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
# Each of these is a choice of the user; the last two count only where the range is ROS's default.
_DECISIONS = (_PROFILES, _TRANSPORTS, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
_LAST_DOMAIN = '232'
_UDP_ONLY = Path(__file__).with_name('fastdds_udp.xml')


def keep_discovery_local(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set `ROS_AUTOMATIC_DISCOVERY_RANGE` to `LOCALHOST`, this machine, unless it is set."""
    environment.setdefault(_RANGE, 'LOCALHOST')


def leave_out_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set environment variables that make Fast DDS use UDP alone.

    Do nothing if the user chose transports, peers, a profile or another middleware. Call it before
    rclpy is initialised and after `keep_discovery_local`, whose variable it may replace.
    """
    middleware = environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    if not middleware.startswith('rmw_fastrtps') or any(map(environment.get, _DECISIONS)):
        return
    if environment.get(_RANGE) != 'LOCALHOST':
        environment[_TRANSPORTS] = 'UDPv4'
    # The last domain has no ports for as many participants as the profile looks for.
    elif environment.get('ROS_DOMAIN_ID') != _LAST_DOMAIN:
        # rmw_fastrtps always adds shared memory for LOCALHOST; the profile replaces the range.
        environment[_RANGE] = 'SYSTEM_DEFAULT'
        environment[_PROFILES] = str(_UDP_ONLY)
