"""An executor for nodes that do other work between callbacks."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from rclpy.executors import Executor
    from rclpy.node import Node

# Seconds between checks of signals and of the graph, for which rclpy has no callback.
BEAT = 0.1
# Callbacks to run where the executor does not report whether any are waiting.
_SERVED_BLINDLY = 10
# Seconds without a call after which the process may have been suspended. Other participants of DDS
# forget a silent one after 20 s.
_SUSPENDED = 10.0
# Seconds after a suspension in which the node announces its name, and between two announcements.
_ANNOUNCING, _ANNOUNCEMENT_PERIOD = 15.0, 1.0
# Counts the time in which the machine sleeps, too.
_CLOCK = getattr(time, 'CLOCK_BOOTTIME', time.CLOCK_MONOTONIC)


class EventLoop:
    """Runs the callbacks of one node in the thread that owns the node.

    It uses rclpy's EventsExecutor, which takes half the CPU time of SingleThreadedExecutor per
    message. With rclpy before 7.1.4, which lacks EventsExecutor, it uses SingleThreadedExecutor.
    It calls only `spin_once`, because `spin` of EventsExecutor runs no callback in some builds.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor, self._is_queue = _make_executor()
        self._executor.add_node(node)
        self._called_at = time.clock_gettime(_CLOCK)
        self._announce_until = self._announce_at = self._called_at

    def wait(self, seconds: float) -> None:
        """Wait up to `seconds` for a callback and run it."""
        self._executor.spin_once(timeout_sec=seconds)
        self._announce_after_suspension()

    def serve_pending(self, limit: int) -> None:
        """Run the callbacks that are waiting now, at most `limit`.

        Callbacks that arrive meanwhile do not run. SingleThreadedExecutor may run them, but at most
        10 in all. With a limit in seconds, the result would depend on the load of the machine.
        """
        self._announce_after_suspension()
        if not self._is_queue:
            # It reports neither what waits nor whether it ran a callback.
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

    def _announce_after_suspension(self) -> None:
        """Publish the name of the node again after a suspension (SIGSTOP, or sleep of the machine).

        During a long suspension, other processes forget this process. Afterwards they find it, but
        not its node names. rmw sends names whenever a node creates or destroys a publisher.
        """
        now = time.clock_gettime(_CLOCK)
        if now - self._called_at > _SUSPENDED:
            self._announce_until = now + _ANNOUNCING
        self._called_at = now
        if now < self._announce_until and now >= self._announce_at:
            self._announce_at = now + _ANNOUNCEMENT_PERIOD
            _announce(self._node)


def _announce(node: Node) -> None:
    from rcl_interfaces.msg import Log

    node.destroy_publisher(node.create_publisher(Log, '~/announcement', 1))


def _make_executor() -> tuple[Executor, bool]:
    """Return an executor, and whether it runs callbacks in the order of their arrival."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(), False
    return EventsExecutor(), True
