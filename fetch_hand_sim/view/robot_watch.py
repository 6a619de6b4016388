"""Follows a robot over its topics: what it does, and every tick as one piece.

It is one subscriber among others, in a process of its own. State comes best effort, so that a
viewer that hangs leaves nothing for the robot to send again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from fetch_hand_sim.simulation.scene import Frame
from msgs_spec.arrays import Array
from msgs_spec.cdr import TopicCodec
from msgs_spec.codecs import decode_status
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.ros import rclpy_profile, ros_message_class
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import QosSpec, TopicSpec, topic

# Nothing is sent twice for a viewer.
WATCHING = QosSpec(depth=5, reliability='best_effort', durability='volatile')
ANY_TASK = next(iter(TASKS.values()))
# What a tick consists of, as it is published. The first step leads to the first reward and command:
# `episode_status` is the last that is said of the tick before it.
_FIRST, _LAST = 'joint_states', 'applied_command'
_NEEDED = (_FIRST, 'desired_goal', 'achieved_goal', 'is_success')
_STATE = (*_NEEDED, 'reward', _LAST)
# Seconds between leaving the topics of a robot and subscribing to those of another: until a topic
# is let go of, which the executor does after the callback, it cannot have another type.
_CHANGE_TIME = 0.2


@dataclass(frozen=True, slots=True)
class SeenTick:
    """What a robot said at one tick.

    Attributes:
        stamp_ns: Simulated time, nanoseconds.
        frame: Where robot, object and goals are.
        reward: Of the tick; None at a reset.
        command: (action size,) what was applied, command units; None at a reset.
    """

    stamp_ns: int
    frame: Frame
    reward: float | None
    command: Array | None


class RobotWatch:
    """Subscribes to the robot in the node's namespace.

    Args:
        node: Of this process.
        on_status: Gets what the robot says of its episode; the task may be another one.
        on_tick: Gets every tick.

    Attributes:
        status: The latest status; None until there is a robot.
    """

    def __init__(
        self,
        node: Node,
        on_status: Callable[[EpisodeStatus], None],
        on_tick: Callable[[SeenTick], None],
    ) -> None:
        self._node = node
        self._on_status = on_status
        self._on_tick = on_tick
        self.status: EpisodeStatus | None = None
        self._values: dict[str, Array] = {}
        self._stamp_ns = 0
        self._subscriptions: list[Any] = []
        self._change: Any = None
        status = topic(ANY_TASK, 'episode_status')
        self.subscribe(status, status.qos, self._take_status)

    @property
    def spec(self) -> TaskSpec | None:
        """The robot's task; None until there is one."""
        status = self.status
        return task_spec(status.task, status.joint_prefix, status.control_hz) if status else None

    @property
    def joint_prefix(self) -> str:
        """What the names of the robot's joints begin with."""
        return self.status.joint_prefix if self.status else JOINT_PREFIX

    def subscribe(
        self, source: TopicSpec, qos: QosSpec, callback: Callable[[Any], None], raw: bool = False
    ) -> Any:
        """Subscribes to a topic; returns rclpy's subscription."""
        message_class = ros_message_class(source.type_name)
        profile = rclpy_profile(qos)
        return self._node.create_subscription(
            message_class, source.name, callback, profile, raw=raw
        )

    def _take_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
            spec = task_spec(status.task, status.joint_prefix, status.control_hz)
        except ValueError:
            return
        if self.status is None or self.status.task != status.task:
            self._follow(spec)
        self.status = status
        self._on_status(status)
        if status.phase == 'reset':
            self._finish_tick()

    def _follow(self, spec: TaskSpec) -> None:
        self._values = {}
        if not self._subscriptions and self._change is None:
            self._subscribe_to(spec)
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._end_change()
        # Of wall time: a node that follows simulated time has none of a robot that is gone.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._change = self._node.create_timer(
            _CHANGE_TIME, lambda: self._subscribe_to(spec), clock=clock
        )

    def _end_change(self) -> None:
        if self._change is not None:
            self._node.destroy_timer(self._change)
            self._change = None

    def _subscribe_to(self, spec: TaskSpec) -> None:
        self._end_change()
        names = [*_STATE, *(['object_pose'] if spec.has_object else [])]
        self._subscriptions = [
            self.subscribe(source, WATCHING, self._collector(source), raw=True)
            for source in (topic(spec, name) for name in names)
        ]

    def _collector(self, source: TopicSpec) -> Callable[[bytes], None]:
        codec = TopicCodec(source)

        def collect(data: bytes) -> None:
            try:
                stamp, values = codec.decode(data)
            except ValueError:
                return
            if source.name == _FIRST:
                # Of the tick before, where its last message was lost.
                self._finish_tick()
                self._values, self._stamp_ns = {}, stamp
            self._values[source.name] = values
            if source.name == _LAST:
                self._finish_tick()

        return collect

    def _finish_tick(self) -> None:
        """Passes the tick on if there is one; nothing of it is left for the next."""
        values, spec = self._values, self.spec
        if spec is None or any(name not in values for name in _NEEDED):
            return
        self._values = {}
        frame = Frame(
            joint_position=values['joint_states'][: len(spec.robot.joints)],
            desired_goal=values['desired_goal'],
            achieved_goal=values['achieved_goal'],
            object_pose=values.get('object_pose'),
            is_success=bool(values['is_success'][0]),
        )
        reward = float(values['reward'][0]) if 'reward' in values else None
        self._on_tick(SeenTick(self._stamp_ns, frame, reward, values.get('applied_command')))
