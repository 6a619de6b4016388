"""`policy_node`: joins the topics of a robot by stamp, runs an actor, publishes its commands.

It knows the robot by topics alone, so it runs as well on another machine or against a replayed
episode.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Float64MultiArray

from msgs_spec.codecs import build_status, decode, decode_status, message_stamp
from msgs_spec.observations import ObservationAssembler
from msgs_spec.parameters import POLICY_NODE
from msgs_spec.qos import STATE, rclpy_profile
from msgs_spec.ros import (
    NodeFailure,
    StopSignals,
    declare_parameters,
    ros_message_class,
    run_node,
)
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TASKS
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import TopicSpec, topic
from policy_node.commander import Commander, make_commander
from policy_node.stamp_join import StampJoin

NODE_NAME = 'policy_node'
# Seconds between looks at the stop flag while nothing arrives.
_SPIN = 0.1
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
        self._commander: Commander | None = None
        self._slow_at = 0.0
        self.failure: str | None = None
        status_topic = topic(_ANY_TASK, 'episode_status')
        self._subscribe(status_topic, self._on_status, rclpy_profile(status_topic.qos))

    def run(self, stop: StopSignals) -> None:
        """Serves until told to stop.

        Raises:
            NodeFailure: If the actor does not fit the robot.
        """
        executor = SingleThreadedExecutor()
        executor.add_node(self)
        self.get_logger().info('waiting for a robot on episode_status')
        try:
            while not stop:
                executor.spin_once(timeout_sec=_SPIN)
                if self.failure:
                    raise NodeFailure(self.failure)
                if self._status is not None and self._commander is None:
                    self._start(self._status, executor, stop)
        finally:
            executor.remove_node(self)

    def _start(
        self, status: EpisodeStatus, executor: SingleThreadedExecutor, stop: StopSignals
    ) -> None:
        """Loads the actor for the robot that was found and begins to answer."""
        try:
            self._check_task(status)
            commander = make_commander(self._settings['checkpoint'], status)
        except ValueError as error:
            raise NodeFailure(str(error)) from None
        spec = commander.spec
        assembler = ObservationAssembler(spec, status.control_hz)
        join = StampJoin(source.name for source in assembler.topics)
        for source in assembler.topics:
            self._subscribe(source, self._joiner(source, join, assembler), rclpy_profile(STATE))
        while not stop and not all(self.count_publishers(s.name) for s in assembler.topics):
            executor.spin_once(timeout_sec=_SPIN)
        self._announce(commander)
        # Last of all: its appearance tells the robot that everything before it is in place.
        commands = topic(spec, 'commands')
        self._commands = self.create_publisher(
            Float64MultiArray, commands.name, rclpy_profile(commands.qos)
        )
        self._tick_duration = 1.0 / status.control_hz
        self._commander = commander
        self.get_logger().info(f'{spec.name}: commands come from {commander.description}')

    def _check_task(self, status: EpisodeStatus) -> None:
        wanted = self._settings['task']
        if wanted and wanted != status.task:
            raise ValueError(f'the robot does {status.task}, not {wanted}')

    def _announce(self, commander: Commander) -> None:
        """Tells the robot's log who commands."""
        status = topic(commander.spec, 'policy_status')
        publisher = self.create_publisher(
            ros_message_class(status.type_name), status.name, rclpy_profile(status.qos)
        )
        values = {'commander': commander.description, 'checkpoint_sha256': commander.sha256}
        message = build_status(status, 0, NODE_NAME, values)
        publisher.publish(serialize(status.type_name, message))

    def _subscribe(self, spec: TopicSpec, callback: Callable[[Any], None], profile: Any) -> None:
        self.create_subscription(ros_message_class(spec.type_name), spec.name, callback, profile)

    def _joiner(
        self, source: TopicSpec, join: StampJoin, assembler: ObservationAssembler
    ) -> Callable[[Any], None]:
        def on_message(message: Any) -> None:
            vectors = join.add(source.name, message_stamp(message), decode(source, message))
            if vectors is not None:
                self._act(assembler.assemble(vectors))

        return on_message

    def _act(self, observation: dict[str, NDArray[np.float64]]) -> None:
        if self._commander is None:
            return
        began = time.monotonic()
        command = self._commander.command(observation)
        message: Any = Float64MultiArray()
        message.data = command.tolist()
        self._commands.publish(message)
        self._warn_if_slow(time.monotonic() - began)

    def _warn_if_slow(self, duration: float) -> None:
        now = time.monotonic()
        if duration > self._tick_duration and now - self._slow_at > _WARN_PERIOD:
            self._slow_at = now
            self.get_logger().warning(
                f'inference took {duration * 1e3:.1f} ms, longer than a tick of '
                f'{self._tick_duration * 1e3:.1f} ms: commands come late'
            )

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
        except ValueError as error:
            self.get_logger().warning(f'ignored: {error}', throttle_duration_sec=_WARN_PERIOD)
            return
        if self._commander is not None and self._status is not None:
            self._check_same_robot(self._status, status)
        self._status = status

    def _check_same_robot(self, before: EpisodeStatus, now: EpisodeStatus) -> None:
        if (now.task, now.control_hz) != (before.task, before.control_hz):
            self.failure = (
                f'the robot changed from {before.task} at {before.control_hz:g} Hz to {now.task} '
                f'at {now.control_hz:g} Hz; start policy_node again for it'
            )


def main(args: list[str] | None = None) -> int:
    """Runs `policy_node`; returns the exit code."""

    def run(stop: StopSignals) -> None:
        node = PolicyNode()
        try:
            node.run(stop)
        finally:
            node.destroy_node()

    return run_node(NODE_NAME, run, args)


if __name__ == '__main__':
    sys.exit(main())
