"""Follow a robot or a replay over its topics, tick by tick."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from fetch_hand_sim.simulation.scene import Frame
from fetch_hand_sim.watch.tick_assembly import NEEDED, WITHOUT_STAMP, TickAssembly, Values
from msgs_spec.arrays import Array
from msgs_spec.codecs import TopicCodec, decode_status
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus, split_messages
from msgs_spec.topics import LATEST_TICK, QosSpec, topic
from node_runtime.ros import count_publishers, subscribe

# QoS of a viewer.
WATCHING = QosSpec(depth=5, reliability='best_effort', durability='volatile')
# QoS for every tick: two seconds at 25 Hz. A busy machine loses best-effort messages.
_FOLLOWING = replace(WATCHING, depth=50, reliability='reliable')
ANY_TASK = next(iter(TASKS.values()))
# Seconds between the end of a robot's subscriptions and those to another robot. The executor
# removes the old ones after the callback; until then a topic cannot have another type.
_CHANGE_TIME = 0.2
# Seconds between two looks for a publisher of `latest_tick`. An incomplete tick is shown if no
# message comes between two looks.
_LOOK_PERIOD = 0.5


@dataclass(frozen=True, slots=True)
class SeenTick:
    """One tick of a robot.

    Attributes:
        stamp_ns: Simulated time, nanoseconds.
        frame: State of robot, object and goals.
        reward: None at a reset, or if its message was lost.
        command: (action size,) applied command; None at a reset, or if its message was lost.
        status: Status of the episode at this tick; None if the tick is not from `latest_tick`.
    """

    stamp_ns: int
    frame: Frame
    reward: float | None
    command: Array | None
    status: EpisodeStatus | None = None


class RobotWatch:
    """Subscribes to the robot in the namespace of `node`.

    Args:
        node: The node of this process.
        on_status: Called with each valid status; its task may differ from the last one.
        on_tick: Called with each tick.
        every_tick: If False, ticks come from the topic `latest_tick` while it has a publisher; its
            rate is limited, so ticks may be missing. Replays do not publish it.

    Attributes:
        status: The latest status; None before the first.
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
        self._assembly = TickAssembly(())
        self._is_quiet = False
        self._every_tick = every_tick
        self._takes_latest = False
        self._codecs: dict[str, TopicCodec] = {}
        self._subscriptions: list[Any] = []
        self._change: Any = None
        self._status_topic = status = topic(ANY_TASK, 'episode_status')
        subscribe(node, status, self._on_status_message)
        # Steady time, because simulated time stops with the robot.
        self._clock = Clock(clock_type=ClockType.STEADY_TIME)
        node.create_timer(_LOOK_PERIOD, self._look, clock=self._clock)

    @property
    def spec(self) -> TaskSpec | None:
        """The robot's task; None before the first status."""
        return spec_of(self.status) if self.status else None

    def _on_status_message(self, message: Any) -> None:
        """Handle an `episode_status` message, unless `latest_tick` delivers the same status."""
        try:
            status = _read_status(message)
        except ValueError:
            return
        if self._is_other(status) or not self._takes_latest or status.phase == 'waiting':
            self._take_status(status)

    def _is_other(self, status: EpisodeStatus) -> bool:
        """Return whether task, rate or joint prefix have changed; True for the first status."""
        return self.status is None or not self.status.is_of_same_robot(status)

    def _take_status(self, status: EpisodeStatus) -> None:
        if self._is_other(status):
            self._follow(spec_of(status))
        self.status = status
        self._on_status(status)
        if status.phase == 'reset':
            self._emit(self._assembly.flush())

    def _take_latest(self, data: bytes) -> None:
        try:
            parts = split_messages(data)
            source = self._status_topic
            status = _read_status(deserialize(source.type_name, parts[source.name]))
            given = {
                name: self._codecs[name].decode(parts[name]) for name in parts.keys() & self._codecs
            }
            stamp_ns = given['joint_states'][0]
        except (KeyError, ValueError):
            return
        self._take_status(status)
        # Without subscriptions, this was the first status of another robot.
        if self._subscriptions and given.keys() >= NEEDED:
            values = {name: values for name, (_, values) in given.items()}
            self._emit([(stamp_ns, values)], status)

    def _look(self) -> None:
        if self._is_quiet:
            self._emit(self._assembly.flush())
        self._is_quiet = True
        if self.spec is not None and self._has_latest() != self._takes_latest:
            self._follow(self.spec)

    def _has_latest(self) -> bool:
        return not self._every_tick and count_publishers(self._node, LATEST_TICK.name) > 0

    def _follow(self, spec: TaskSpec) -> None:
        self._assembly = TickAssembly(())
        if not self._subscriptions and self._change is None:
            self._subscribe_to(spec)
            return
        while self._subscriptions:
            self._node.destroy_subscription(self._subscriptions.pop())
        self._end_change()
        self._change = self._node.create_timer(
            _CHANGE_TIME, lambda: self._finish_change(spec), clock=self._clock
        )

    def _finish_change(self, spec: TaskSpec) -> None:
        # On a busy machine a timer runs once more after it was destroyed.
        if self._change is not None:
            self._end_change()
            self._subscribe_to(spec)

    def _end_change(self) -> None:
        if self._change is not None:
            self._node.destroy_timer(self._change)
            self._change = None

    def _subscribe_to(self, spec: TaskSpec) -> None:
        names = NEEDED | WITHOUT_STAMP | ({'object_pose'} if spec.has_object else set())
        self._codecs = {name: TopicCodec(topic(spec, name)) for name in names}
        self._assembly = TickAssembly(names)
        self._takes_latest = self._has_latest()
        collectors = {each.topic: self._collector(each) for each in self._codecs.values()}
        callbacks = {LATEST_TICK: self._take_latest} if self._takes_latest else collectors
        qos = WATCHING if self._takes_latest else _FOLLOWING
        self._subscriptions = [
            subscribe(self._node, source, callback, qos=qos, raw=True)
            for source, callback in callbacks.items()
        ]

    def _collector(self, codec: TopicCodec) -> Callable[[bytes], None]:
        def collect(data: bytes) -> None:
            try:
                stamp_ns, values = codec.decode(data)
            except ValueError:
                return
            self._is_quiet = False
            self._emit(self._assembly.add(codec.topic.name, stamp_ns, values))

        return collect

    def _emit(
        self, ticks: Iterable[tuple[int, Values]], status: EpisodeStatus | None = None
    ) -> None:
        """Call `on_tick` for stamps and values of ticks.

        The position of a joint that the robot does not publish is 0.
        """
        spec = self.spec
        if spec is None:
            return
        for stamp_ns, values in ticks:
            positions = values['joint_states'][: len(spec.robot.joints)]
            frame = Frame(
                joint_position=np.where(np.isfinite(positions), positions, 0.0),
                desired_goal=values['desired_goal'],
                achieved_goal=values['achieved_goal'],
                object_pose=values.get('object_pose'),
                is_success='is_success' in values and bool(values['is_success'][0]),
            )
            reward = float(values['reward'][0]) if 'reward' in values else None
            command = values.get('applied_command')
            self._on_tick(SeenTick(stamp_ns, frame, reward, command, status))


def _read_status(message: Any) -> EpisodeStatus:
    """Parse an `episode_status` message; ValueError if it is invalid or its task is unknown."""
    status = EpisodeStatus.from_values(decode_status(message))
    spec_of(status)
    return status


def spec_of(status: EpisodeStatus) -> TaskSpec:
    """Return the task of a status, with its joint names and steps per episode."""
    return task_spec(status.task, status.joint_prefix, status.control_hz)
