"""Follows a robot over its topics: what it does, and every tick as one piece.

It is one subscriber among others, in a process of its own. State comes best effort, so that a
viewer that hangs leaves nothing for the robot to send again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from fetch_hand_sim.simulation.scene import Frame
from msgs_spec.arrays import Array
from msgs_spec.cdr import TopicCodec
from msgs_spec.codecs import decode_status
from msgs_spec.latest_tick import split_messages
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import LATEST_TICK, QosSpec, TopicSpec, topic
from node_runtime.ros import count_publishers, rclpy_profile, ros_message_class

# Nothing is sent twice for a viewer.
WATCHING = QosSpec(depth=5, reliability='best_effort', durability='volatile')
# For every tick: two seconds of a robot at 25 Hz, should the viewer get no processor so long.
_FOLLOWING = replace(WATCHING, depth=50)
ANY_TASK = next(iter(TASKS.values()))
# What a tick consists of, as it is published. The first step leads to the first reward and command:
# `episode_status` is the last that is said of the tick before it.
_FIRST, _LAST = 'joint_states', 'applied_command'
_NEEDED = (_FIRST, 'desired_goal', 'achieved_goal', 'is_success')
_STATE = (*_NEEDED, 'reward', _LAST)
# Seconds between leaving the topics of a robot and subscribing to those of another: until a topic
# is let go of, which the executor does after the callback, it cannot have another type.
_CHANGE_TIME = 0.2
# What a codec says of messages without one.
_NO_STAMP = 0
# Seconds between two looks at whether there is `latest_tick`.
_CHOICE_PERIOD = 0.5


@dataclass(frozen=True, slots=True)
class SeenTick:
    """What a robot said at one tick.

    Attributes:
        stamp_ns: Simulated time, nanoseconds.
        frame: Where robot, object and goals are.
        reward: Of the tick; None at a reset.
        command: (action size,) what was applied, command units; None at a reset.
        status: Of the episode at this tick; None where that did not come along.
    """

    stamp_ns: int
    frame: Frame
    reward: float | None
    command: Array | None
    status: EpisodeStatus | None = None


class RobotWatch:
    """Subscribes to the robot in the node's namespace.

    Args:
        node: Of this process.
        on_status: Gets what the robot says of its episode; it may be another robot.
        on_tick: Gets every tick, or the latest.
        every_tick: Whether each counts, also of a robot that is faster than eyes are. If not,
            `latest_tick` is taken where there is one; replays have none.

    Attributes:
        status: The latest status; None until there is a robot.
    """

    def __init__(
        self,
        node: Node,
        on_status: Callable[[EpisodeStatus], None],
        on_tick: Callable[[SeenTick], None],
        every_tick: bool = True,
    ) -> None:
        self._node = node
        self._on_status = on_status
        self._on_tick = on_tick
        self.status: EpisodeStatus | None = None
        self._values: dict[str, Array] = {}
        self._stamp_ns = 0
        self._every_tick = every_tick
        self._takes_latest = False
        self._codecs: dict[str, TopicCodec] = {}
        self._subscriptions: list[Any] = []
        self._change: Any = None
        self._status_topic = status = topic(ANY_TASK, 'episode_status')
        self.subscribe(status, status.qos, self._hear_status)
        # In wall time: simulated time stands still with a robot that is gone.
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        if not every_tick:
            node.create_timer(_CHOICE_PERIOD, self._choose, clock=self._clock)

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

    def _hear_status(self, message: Any) -> None:
        """Takes a status from its own topic: `latest_tick` brings that of a robot which ticks."""
        status = _read_status(message)
        if status is None:
            return
        if self._is_other(status) or not self._takes_latest or status.phase == 'waiting':
            self._take_status(status)

    def _is_other(self, status: EpisodeStatus) -> bool:
        """Whether this is said by another robot than before."""
        return self.status is None or not self.status.is_of_same_robot(status)

    def _take_status(self, status: EpisodeStatus) -> None:
        if self._is_other(status):
            self._follow(task_spec(status.task, status.joint_prefix, status.control_hz))
        self.status = status
        self._on_status(status)
        if status.phase == 'reset':
            self._finish_tick()

    def _take_latest(self, data: bytes) -> None:
        try:
            parts = split_messages(data)
            source = self._status_topic
            status = _read_status(deserialize(source.type_name, parts[source.name]))
            given = {
                name: self._codecs[name].decode(parts[name]) for name in parts.keys() & self._codecs
            }
            stamp_ns = given[_FIRST][0]
        except (KeyError, ValueError):
            return
        if status is None:
            return
        self._take_status(status)
        # Not where that was another robot's, whose topics are still to come.
        if self._subscriptions:
            self._values = {name: values for name, (_, values) in given.items()}
            self._stamp_ns = stamp_ns
            self._finish_tick(status)

    def _choose(self) -> None:
        if self.spec is not None and self._has_latest() != self._takes_latest:
            self._follow(self.spec)

    def _has_latest(self) -> bool:
        return not self._every_tick and count_publishers(self._node, LATEST_TICK.name) > 0

    def _follow(self, spec: TaskSpec) -> None:
        self._values = {}
        if not self._subscriptions and self._change is None:
            self._subscribe_to(spec)
            return
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._end_change()
        self._change = self._node.create_timer(
            _CHANGE_TIME, lambda: self._subscribe_to(spec), clock=self._clock
        )

    def _end_change(self) -> None:
        if self._change is not None:
            self._node.destroy_timer(self._change)
            self._change = None

    def _subscribe_to(self, spec: TaskSpec) -> None:
        self._end_change()
        names = [*_STATE, *(['object_pose'] if spec.has_object else [])]
        self._codecs = {name: TopicCodec(topic(spec, name)) for name in names}
        self._takes_latest = self._has_latest()
        if self._takes_latest:
            latest = self.subscribe(LATEST_TICK, WATCHING, self._take_latest, raw=True)
            self._subscriptions = [latest]
            return
        self._subscriptions = [
            self.subscribe(each.topic, _FOLLOWING, self._collector(each), raw=True)
            for each in self._codecs.values()
        ]

    def _collector(self, codec: TopicCodec) -> Callable[[bytes], None]:
        source = codec.topic

        def collect(data: bytes) -> None:
            try:
                stamp, values = codec.decode(data)
            except ValueError:
                return
            if source.name == _FIRST:
                # The tick before ends here too, where its last message was lost.
                self._finish_tick()
                self._values, self._stamp_ns = {}, stamp
            elif stamp not in (_NO_STAMP, self._stamp_ns):
                # A tick whose first message was lost must not pass for this one.
                self._finish_tick()
                self._values = {}
            self._values[source.name] = values
            if source.name == _LAST:
                self._finish_tick()

        return collect

    def _finish_tick(self, status: EpisodeStatus | None = None) -> None:
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
        command = values.get('applied_command')
        self._on_tick(SeenTick(self._stamp_ns, frame, reward, command, status))


def _read_status(message: Any) -> EpisodeStatus | None:
    """What an `episode_status` says; None if that is no robot of ours."""
    try:
        status = EpisodeStatus.from_values(decode_status(message))
        task_spec(status.task, status.joint_prefix, status.control_hz)
    except ValueError:
        return None
    return status
