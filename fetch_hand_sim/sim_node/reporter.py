"""What a robot says about itself: a report once a second, and what is new in the log."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from fetch_hand_sim.sim_node.graph_watch import GraphWatch
from fetch_hand_sim.sim_node.health import Health, Surroundings, lasting_problems, waiting_line
from fetch_hand_sim.sim_node.robot import Messages, Robot
from msgs_spec.cdr import TopicCodec
from msgs_spec.diagnostics import encode_reports
from msgs_spec.topics import DIAGNOSTICS, REAL_TIME_FACTOR
from node_runtime.ros import seldom

if TYPE_CHECKING:
    from rclpy.node import Node

# Seconds between two lines about what a robot waits for, and before the first command of all.
WAITING_PERIOD = 5.0


@dataclass(frozen=True, slots=True)
class LogState:
    """Where episodes are logged.

    Attributes:
        directory: The directory; empty for none.
        has_failed: Whether logging has stopped.
    """

    directory: str
    has_failed: bool

    def __str__(self) -> str:
        """What a report says of it."""
        if self.has_failed:
            return f'logging to {self.directory} has failed'
        return self.directory or 'off'


class Reporter:
    """Reports on a robot to `/diagnostics` and to the log of its node.

    Args:
        node: The robot's.
        robot: The robot.
        watch: What the graph shows, kept up to date by the node.
        log_state: Returns where episodes are logged now.
    """

    def __init__(
        self, node: Node, robot: Robot, watch: GraphWatch, log_state: Callable[[], LogState]
    ) -> None:
        self._node = node
        self._robot = robot
        self._watch = watch
        self._log_state = log_state
        self._publishes_clock = bool(node.get_parameter('publish_clock').value)
        self._health = Health(robot, node.get_fully_qualified_name(), time.monotonic())
        self._factor_codec = TopicCodec(REAL_TIME_FACTOR)
        self._commanders: list[str] = []
        self._said: set[str] = set()
        self._has_said_far_out = False

    def report(self, now: float) -> Messages:
        """Closes a period: returns its messages and logs what is new.

        Args:
            now: Seconds of `time.monotonic`.
        """
        surroundings = self._surroundings()
        report = self._health.report(surroundings, now)
        self._say_news(surroundings)
        factor = self._factor_codec.encode(0, [self._health.real_time_factor])
        return [(DIAGNOSTICS, encode_reports(report)), (REAL_TIME_FACTOR, factor)]

    def say_what_is_waited_for(self) -> None:
        """Logs it, every `WAITING_PERIOD` seconds at most."""
        line = waiting_line(self._robot, self._surroundings())
        self._node.get_logger().warning(line, **seldom(WAITING_PERIOD))

    def _surroundings(self) -> Surroundings:
        watch, log = self._watch, self._log_state()
        names = watch.inputs.commanders
        return Surroundings(
            commanders=names,
            commander_problems=watch.inputs.problems(),
            robots=watch.robots,
            waiting_elsewhere=watch.waiting_elsewhere() if not names else [],
            clock_publishers=watch.clock_publishers,
            publishes_clock=self._publishes_clock,
            log=str(log),
            has_log_failed=log.has_failed,
        )

    def _say_news(self, surroundings: Surroundings) -> None:
        """Logs who commands when it changes, and each problem once when it begins."""
        logger, buffer = self._node.get_logger(), self._robot.buffer
        if surroundings.commanders != self._commanders:
            self._commanders = list(surroundings.commanders)
            names = ', '.join(self._commanders) or 'nobody any more'
            logger.info(f'commands come from {names}')
        if buffer.far_out and not self._has_said_far_out:
            self._has_said_far_out = True
            logger.warning(f'command clipped from far out of range: {buffer.last_far_out}')
        problems = {line for _, line in lasting_problems(self._robot, surroundings)}
        for line in sorted(problems - self._said):
            logger.warning(line)
        self._said = problems
