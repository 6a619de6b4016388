"""Received messages of a robot: reading, dispatch, logging. Without rclpy."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, Protocol

from fetch_hand_sim.episodes.runner import accept_perturbation
from fetch_hand_sim.sim_node.robot import Robot
from msgs_spec.codecs import answered_stamp, decode_status
from msgs_spec.schemas import deserialize, require_short, serialize
from msgs_spec.topics import TopicSpec


class ReceivedLog(Protocol):
    """The recorder's method for received messages."""

    def record_received(self, topic: TopicSpec, data: bytes, *, is_refused: bool) -> None:
        """Record the CDR bytes of one message, and whether the robot rejected it."""


class Receivers:
    """Pass received messages to a robot; rejected ones are counted and reported, never raised.

    The log contains every readable message, also rejected commands. Unreadable and oversized bytes
    are dropped.

    Args:
        robot: Executes commands and goals.
        log: Records messages; None for no log.
        on_commander: Receives the SHA-256 of the policy's checkpoint, or None.
        warn: Receives the topic and a line about a rejected message; throttles.
    """

    def __init__(
        self,
        robot: Robot,
        log: ReceivedLog | None,
        on_commander: Callable[[str | None], None],
        warn: Callable[[str, str], None],
    ) -> None:
        self._robot = robot
        self._log = log
        self._on_commander = on_commander
        self._warn = warn
        self._handlers: dict[str, Callable[[TopicSpec, Any], None]] = {
            'commands': lambda spec, message: robot.buffer.accept(
                message.data, answered_stamp(message)
            ),
            'joint_commands': lambda spec, message: robot.buffer.accept_named(
                message.name, message.position
            ),
            'set_goal': robot.set_goal,
            'perturb': lambda spec, message: accept_perturbation(
                robot.runner, spec, message, robot.perturb_limit
            ),
            'policy_status': self._policy_status,
        }

    def callback(self, spec: TopicSpec) -> Callable[[bytes], None]:
        """Return the callback of a raw subscription."""
        handle = self._handlers[spec.name]

        def on_message(data: bytes) -> None:
            message = self._read(spec, data)
            if message is None:
                return
            is_rejected = False
            try:
                handle(spec, message)
            except ValueError as error:
                is_rejected = True
                self._warn(spec.name, str(error))
            if self._log is not None:
                # Serialised again, because senders leave the bytes between fields uninitialised.
                data = serialize(spec.type_name, message)
                self._log.record_received(spec, data, is_refused=is_rejected)

        return on_message

    def _read(self, spec: TopicSpec, data: bytes) -> Any:
        """Return the message, or None after counting and reporting unreadable bytes."""
        try:
            require_short(data)
        except ValueError as error:
            return self._drop(spec, 'too long', str(error))
        try:
            return deserialize(spec.type_name, data)
        except ValueError as error:
            return self._drop(spec, 'unreadable', str(error))

    def _drop(self, spec: TopicSpec, reason: str, line: str) -> None:
        if spec.name == 'set_goal':
            self._robot.count_rejected_goal(line)
        elif spec.name.endswith('commands'):
            self._robot.buffer.count_rejection(reason, line)
        self._warn(spec.name, line)

    def _policy_status(self, spec: TopicSpec, message: Any) -> None:
        del spec
        sha256 = decode_status(message).get('checkpoint_sha256') or None
        if sha256 and not re.fullmatch('[0-9a-f]{64}', sha256):
            raise ValueError(f'checkpoint_sha256 {sha256[:40]!r} given; allowed: 64 hex digits')
        self._on_commander(sha256)
