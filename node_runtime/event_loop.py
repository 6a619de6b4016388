"""Serves the callbacks of a node, a few at a time, beside what else it has to do."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

# Seconds between looks at what no callback announces: signals, the graph.
BEAT = 0.1
# Callbacks that an executor is asked for which does not say whether there are any.
_SERVED_BLINDLY = 10


class EventLoop:
    """Serves the callbacks of one node, from the thread that owns it.

    rclpy's EventsExecutor costs half of the wait-set one per message. It is used through
    `spin_once` alone, because its `spin` serves nothing in some builds. Releases before 7.1.4 lack
    it.

    Args:
        node: Whose callbacks.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor, self._is_queue = _make_executor()
        self._executor.add_node(node)

    def wait(self, seconds: float) -> None:
        """Serves one callback, or none within that time."""
        self._executor.spin_once(timeout_sec=seconds)

    def serve_pending(self, limit: int) -> None:
        """Serves what has been waiting, not what arrives meanwhile.

        Args:
            limit: Callbacks served at most. What comes in faster than it is served would otherwise
                take longer every time. A number and not a time, so that a busy machine changes
                nothing.
        """
        if not self._is_queue:
            # It says neither what waits nor whether it has served anything, and asking takes time.
            for _ in range(min(limit, _SERVED_BLINDLY)):
                self._executor.spin_once(timeout_sec=0.0)
            return
        # First in, first out: the mark comes last of what is there.
        reached: list[bool] = []
        self._executor.create_task(lambda: reached.append(True))
        for _ in range(limit):
            self._executor.spin_once(timeout_sec=0.0)
            if reached:
                return

    def close(self) -> None:
        """Gives the node back."""
        self._executor.remove_node(self._node)


def _make_executor() -> tuple[Executor, bool]:
    """Returns an executor and whether it serves a queue in order."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(), False
    return EventsExecutor(), True
