"""An executor for nodes that do other work between callbacks."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

# Seconds between checks of signals and of the graph, for which rclpy has no callback.
BEAT = 0.1
# Callbacks to ask for where the executor does not tell whether any are waiting.
_SERVED_BLINDLY = 10


class EventLoop:
    """Run the callbacks of one node in the thread that owns the node.

    rclpy's EventsExecutor costs half of the wait-set executor per message; rclpy before 7.1.4 lacks
    it. It is used through `spin_once` alone, because its `spin` serves nothing in some builds.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor, self._is_queue = _make_executor()
        self._executor.add_node(node)

    def wait(self, seconds: float) -> None:
        """Run one callback; return without one after `seconds`."""
        self._executor.spin_once(timeout_sec=seconds)

    def serve_pending(self, limit: int) -> None:
        """Run the callbacks that are waiting now, without those that arrive meanwhile.

        Args:
            limit: Maximum number of callbacks. A number and not a time, so that the result does not
                depend on the load of the machine.
        """
        if not self._is_queue:
            # It tells neither what waits nor whether it ran a callback.
            for _ in range(min(limit, _SERVED_BLINDLY)):
                self._executor.spin_once(timeout_sec=0.0)
            return
        # First in, first out: this task runs after all that wait now.
        reached: list[bool] = []
        self._executor.create_task(lambda: reached.append(True))
        for _ in range(limit):
            self._executor.spin_once(timeout_sec=0.0)
            if reached:
                return

    def close(self) -> None:
        """Remove the node from the executor."""
        self._executor.remove_node(self._node)


def _make_executor() -> tuple[Executor, bool]:
    """Return an executor and whether it serves a queue in order."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(), False
    return EventsExecutor(), True
