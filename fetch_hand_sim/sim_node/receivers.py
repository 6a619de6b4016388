"""What the robot does with the messages it receives; nothing here needs rclpy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol

from fetch_hand_sim.sim_node.command_buffer import CommandRejected
from fetch_hand_sim.sim_node.robot import Robot
from msgs_spec.codecs import decode_status
from msgs_spec.schemas import deserialize, serialize
from msgs_spec.topics import TopicSpec


class ReceivedLog(Protocol):
    """Keeps what was received beside what was published."""

    def record_received(self, topic: TopicSpec, data: bytes) -> None:
        """Takes the CDR bytes of one message."""


class Receivers:
    """Hands received messages to a robot; what it refuses is said and counted, never raised."""

    def __init__(
        self,
        robot: Robot,
        log: ReceivedLog | None,
        on_commander: Callable[[str | None], None],
        warn: Callable[[str], None],
    ) -> None:
        """Connects.

        Args:
            robot: Gets commands and goals.
            log: Gets every message; None for none.
            on_commander: Gets the SHA-256 of the commander's checkpoint, None if it has none.
            warn: Gets a line about what was refused; expected to throttle.
        """
        self._robot = robot
        self._log = log
        self._on_commander = on_commander
        self._warn = warn
        self._handlers: dict[str, Callable[[TopicSpec, Any], None]] = {
            'commands': self._command,
            'joint_commands': self._joint_command,
            'set_goal': self._goal,
            'policy_status': self._policy_status,
        }

    def callback(self, spec: TopicSpec) -> Callable[[bytes], None]:
        """Returns what a raw subscription of this topic calls with the bytes of each message."""
        handle = self._handlers[spec.name]

        def on_message(data: bytes) -> None:
            try:
                message = deserialize(spec.type_name, data)
            except ValueError as error:
                self._drop(spec, error)
                return
            if self._log is not None:
                # Serialised again, because senders leave the bytes between fields uninitialised.
                self._log.record_received(spec, serialize(spec.type_name, message))
            handle(spec, message)

        return on_message

    def _drop(self, spec: TopicSpec, error: ValueError) -> None:
        """Counts bytes that are no message."""
        if spec.name == 'set_goal':
            self._robot.counters.goals_rejected += 1
        elif spec.name != 'policy_status':
            self._robot.buffer.rejected['unreadable'] += 1
        self._warn(f'{spec.name} dropped: {error}')

    def _command(self, spec: TopicSpec, message: Any) -> None:
        del spec
        try:
            self._robot.accept_command(message.data)
        except CommandRejected as error:
            self._warn(str(error))

    def _joint_command(self, spec: TopicSpec, message: Any) -> None:
        del spec
        try:
            self._robot.accept_named_command(message.name, message.position)
        except CommandRejected as error:
            self._warn(str(error))

    def _goal(self, spec: TopicSpec, message: Any) -> None:
        try:
            self._robot.set_goal(spec, message)
        except ValueError as error:
            self._warn(f'goal dropped: {error}')

    def _policy_status(self, spec: TopicSpec, message: Any) -> None:
        del spec
        self._on_commander(decode_status(message).get('checkpoint_sha256') or None)
