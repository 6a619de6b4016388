"""The ROS node around a `Responder`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher

from msgs_spec.codecs import build_status, decode_status
from msgs_spec.diagnostics import REPORT_PERIOD, encode_reports
from msgs_spec.parameters import POLICY_NODE
from msgs_spec.ros import (
    BEAT,
    EventLoop,
    NodeFailure,
    StopSignals,
    declare_parameters,
    rclpy_profile,
    ros_message_class,
)
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TASKS
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, STATE, TopicSpec, topic
from policy_node.node import NODE_NAME
from policy_node.node.health import Health
from policy_node.node.responder import Responder
from policy_node.policies.commander import Commander, make_commander

_WARN_PERIOD = 1.0
_ANY_TASK = next(iter(TASKS.values()))


class PolicyNode(Node):
    """Waits for a robot, checks that the actor fits it, then answers every tick with a command."""

    def __init__(self) -> None:
        """Declares parameters and listens for a robot.

        Raises:
            UsageError: If a parameter is not allowed.
        """
        super().__init__(NODE_NAME)
        self._settings = declare_parameters(self, POLICY_NODE)
        self._status: EpisodeStatus | None = None
        self._responder: Responder | None = None
        self._commands: Publisher | None = None
        self._failure: str | None = None
        self._health = Health(self.get_fully_qualified_name())
        self._diagnostics = self._publisher(DIAGNOSTICS)
        self._report_due = time.monotonic() + REPORT_PERIOD
        status_topic = topic(_ANY_TASK, 'episode_status')
        self.create_subscription(
            ros_message_class(status_topic.type_name),
            status_topic.name,
            self._on_status,
            rclpy_profile(status_topic.qos),
        )

    def run(self, stop: StopSignals) -> None:
        """Serves until told to stop.

        Raises:
            NodeFailure: If the actor does not fit the robot.
        """
        loop = EventLoop(self)
        self.get_logger().info('waiting for a robot on episode_status')
        try:
            while not stop:
                loop.wait(BEAT)
                if self._failure:
                    raise NodeFailure(self._failure)
                if self._responder is not None:
                    self._responder.send_unsent()
                elif self._status is not None:
                    self._start(self._status, loop, stop)
                self._report_when_due()
        finally:
            loop.close()

    def _start(self, status: EpisodeStatus, loop: EventLoop, stop: StopSignals) -> None:
        """Loads the actor for the robot that was found and begins to answer."""
        try:
            self._check_task(status)
            commander = make_commander(self._settings['checkpoint'], status)
        except ValueError as error:
            raise NodeFailure(str(error)) from None
        self._responder = responder = Responder(commander, status, self._send)
        for source in responder.topics:
            self.create_subscription(
                ros_message_class(source.type_name),
                source.name,
                self._receiver(responder, source.name),
                rclpy_profile(STATE),
                raw=True,
            )
        while not stop and not all(self.count_publishers(s.name) for s in responder.topics):
            loop.wait(BEAT)
        self._announce(commander)
        # Last of all: its appearance tells the robot that everything before it is in place.
        self._commands = self._publisher(topic(commander.spec, 'commands'))
        self._health.start(commander, responder, status)
        self.get_logger().info(f'{commander.spec.name}: commands come from {commander.description}')

    def _check_task(self, status: EpisodeStatus) -> None:
        wanted = self._settings['task']
        if wanted and wanted != status.task:
            raise ValueError(f'the robot does {status.task}, not {wanted}')

    def _announce(self, commander: Commander) -> None:
        """Tells the robot's log who commands."""
        status = topic(commander.spec, 'policy_status')
        values = {'commander': commander.description, 'checkpoint_sha256': commander.sha256}
        message = build_status(status, 0, NODE_NAME, values)
        self._publisher(status).publish(serialize(status.type_name, message))

    def _publisher(self, spec: TopicSpec) -> Publisher:
        return self.create_publisher(
            ros_message_class(spec.type_name), spec.name, rclpy_profile(spec.qos)
        )

    def _receiver(self, responder: Responder, name: str) -> Callable[[bytes], None]:
        def on_message(data: bytes) -> None:
            try:
                responder.receive(name, data)
            except ValueError as error:
                self.get_logger().warning(
                    f'state dropped: {error}', throttle_duration_sec=_WARN_PERIOD
                )

        return on_message

    def _send(self, data: bytes) -> bool:
        """Publishes a command, unless nobody listens: it would be lost, and lockstep with it."""
        if self._commands is None or not self._commands.get_subscription_count():
            return False
        self._commands.publish(data)
        return True

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
        except ValueError as error:
            self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=_WARN_PERIOD)
            return
        if self._responder is not None and self._status is not None:
            self._check_same_robot(self._status, status)
            if status.phase == 'waiting':
                self._responder.forget()
        self._status = status

    def _check_same_robot(self, before: EpisodeStatus, now: EpisodeStatus) -> None:
        if (now.task, now.control_hz) != (before.task, before.control_hz):
            self._failure = (
                f'the robot changed from {before.task} at {before.control_hz:g} Hz to {now.task} '
                f'at {now.control_hz:g} Hz; start policy_node again for it'
            )

    def _report_when_due(self) -> None:
        now = time.monotonic()
        if now < self._report_due:
            return
        self._report_due = max(self._report_due + REPORT_PERIOD, now)
        report = self._health.report(now, self.count_publishers('episode_status'))
        self._diagnostics.publish(encode_reports(self.get_clock().now().nanoseconds, [report]))
        for line in self._health.news(report):
            self.get_logger().warning(line)
