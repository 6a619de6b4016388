"""Find a replay node in the ROS graph and measure its rate."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node, NodeNameNonExistentError

from msgs_spec.topics import PAUSE, RESET
from node_runtime.ros import full_name

# Seconds over which the ticks of a replay are counted.
_COUNT_PERIOD = 1.0
# Looks after which a tick was certainly published after the pause.
_SETTLED = 2


@dataclass(frozen=True, slots=True)
class Replay:
    """A replay node: fully qualified names of the node and of its pause service."""

    name: str
    pause: str


class ReplayWatch:
    """Finds a replay node in the ROS graph and measures its rate.

    Attributes:
        replay: The replay node; None without one, or if a robot also runs.
        rate: Measured ticks per wall-clock second; 0 in the first second.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self.replay: Replay | None = None
        self.rate = 0.0
        self._ticks = 0
        self._since = time.monotonic()
        self._moved = False
        self._paused_looks = 0

    def count_tick(self) -> None:
        """Count a tick of the replay, for `rate` and `stands_still`."""
        self._ticks += 1
        self._moved = True

    def look(self) -> bool:
        """Update `replay` and `rate` from the ROS graph; return whether `replay` has changed."""
        found, before = _find_replay(self._node), self.replay
        self.replay = found
        now = time.monotonic()
        if found != before:
            self.rate, self._paused_looks = 0.0, 0
        elif (elapsed := now - self._since) >= _COUNT_PERIOD:
            self.rate = self._ticks / elapsed
        else:
            return False
        self._ticks, self._since = 0, now
        return found != before

    def stands_still(self, is_paused: bool) -> bool:
        """Return `is_paused`, but False if a tick has arrived since the last call.

        Call it periodically. The first two calls of a pause ignore ticks, which may precede it.
        """
        moved, self._moved = self._moved, False
        self._paused_looks = self._paused_looks + 1 if is_paused else 0
        return is_paused and not (moved and self._paused_looks > _SETTLED)


def status_publishers(node: Node) -> frozenset[bytes]:
    """Return the ids of the publishers of `episode_status`; a restarted robot has another id."""
    return frozenset(bytes(info.endpoint_gid) for info in _publishers(node))


def _publishers(node: Node) -> list[Any]:
    found: list[Any] = node.get_publishers_info_by_topic(node.resolve_topic_name('episode_status'))
    return found


def _find_replay(node: Node) -> Replay | None:
    found = [_as_replay(node, info) for info in _publishers(node)]
    # Beside a robot, a replay is not followed.
    return found[0] if found and None not in found else None


def _as_replay(node: Node, info: Any) -> Replay | None:
    """Return a publisher's node if it is a replay (offers pause but not reset), else None."""
    name, namespace = info.node_name, info.node_namespace
    if not namespace.startswith('/'):
        # The publisher was discovered before its node.
        return None
    try:
        services = node.get_service_names_and_types_by_node(name, namespace)
    except NodeNameNonExistentError:
        return None
    if any(RESET.type_name in types for _, types in services):
        return None
    pauses = [service for service, types in services if PAUSE.type_name in types]
    return Replay(full_name(namespace, name), pauses[0]) if pauses else None
