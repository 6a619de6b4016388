"""Who replays an episode where a robot would be, and how fast it does."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from rclpy.node import Node, NodeNameNonExistentError

from msgs_spec.services import PAUSE, RESET
from node_runtime.ros import full_name

# Seconds over which ticks are counted.
_PERIOD = 1.0
# Looks after which a tick was sent after the pause for sure, and not before.
_SETTLED = 2


@dataclass(frozen=True, slots=True)
class Replay:
    """A node that replays.

    Attributes:
        name: Fully qualified, whatever it is called.
        pause: Its service that stops and goes on, fully qualified.
    """

    name: str
    pause: str


class ReplayWatch:
    """Looks at the graph and counts ticks, for a replay says nothing about itself.

    Args:
        node: Of this process.

    Attributes:
        replay: Who replays; None where nobody does, or a robot runs.
        rate: Ticks per second in the last period.
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
        """Counts a tick that came."""
        self._ticks += 1
        self._moved = True

    def look(self) -> bool:
        """Takes in what the graph shows; returns whether that is another replay than before."""
        found, before = _find_replay(self._node), self.replay
        self.replay = found
        now = time.monotonic()
        if found != before:
            self.rate, self._paused_looks = 0.0, 0
        elif (elapsed := now - self._since) >= _PERIOD:
            self.rate = self._ticks / elapsed
        else:
            return False
        self._ticks, self._since = 0, now
        return found != before

    def stands_still(self, is_paused: bool) -> bool:
        """Whether a replay that was paused still is: others may let it go on.

        Args:
            is_paused: Whether it was at the last look.
        """
        moved, self._moved = self._moved, False
        self._paused_looks = self._paused_looks + 1 if is_paused else 0
        return is_paused and not (moved and self._paused_looks > _SETTLED)


def _find_replay(node: Node) -> Replay | None:
    status = node.resolve_topic_name('episode_status')
    found = [_as_replay(node, info) for info in node.get_publishers_info_by_topic(status)]
    # What is said beside a robot is the robot's.
    return found[0] if found and None not in found else None


def _as_replay(node: Node, info: Any) -> Replay | None:
    """Takes a publisher for a replay if its node can be paused and not be reset."""
    name, namespace = info.node_name, info.node_namespace
    if not namespace.startswith('/'):
        # A publisher may be discovered before its node.
        return None
    try:
        services = node.get_service_names_and_types_by_node(name, namespace)
    except NodeNameNonExistentError:
        return None
    if any(RESET.type_name in types for _, types in services):
        return None
    pauses = [service for service, types in services if PAUSE.type_name in types]
    return Replay(full_name(namespace, name), pauses[0]) if pauses else None
