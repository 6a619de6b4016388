"""A running robot as the page sees it: topics in, services and parameters out.

It is one subscriber among others, in a process of its own. State comes best effort, so that a page
that hangs leaves nothing for the robot to send again.
"""

from __future__ import annotations

import dataclasses
import time
from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.node import Node

from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame, tracked_position
from fetch_hand_sim.view.curves import Curves
from fetch_hand_sim.view.messages import (
    ChooseActor,
    Facts,
    LatestRequest,
    Picture,
    Push,
    ReleaseGoal,
    Request,
    Reset,
    SetCommand,
    SetCommanding,
    SetGoal,
    SetPaused,
    SetSpeed,
    StepOnce,
)
from fetch_hand_sim.view.remote_node import RemoteNode
from msgs_spec.cdr import TopicCodec
from msgs_spec.codecs import build_message, decode_status
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.ros import rclpy_profile, ros_message_class
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, QosSpec, TopicSpec, topic

Array = NDArray[np.float64]

# Nothing is sent twice for a page.
_WATCHING = QosSpec(depth=5, reliability='best_effort', durability='volatile')
_TRAIL_TICKS = 40
_ANY_TASK = next(iter(TASKS.values()))
_STATE = ('joint_states', 'desired_goal', 'achieved_goal', 'reward', 'applied_command')
# Seconds a goal is shown before the robot confirms it.
_GOAL_PATIENCE = 0.5


class LiveRobot:
    """Follows one robot and passes on what the page asks for."""

    def __init__(self, node: Node, may_command: bool) -> None:
        """Listens for a robot in the node's namespace.

        Args:
            node: Of this process.
            may_command: Whether the page may act.
        """
        self._node = node
        self._may_command = may_command
        self._sim = RemoteNode(node, 'sim_node', self._notice)
        self._policy = RemoteNode(node, 'policy_node', self._notice)
        self._sim_name = f'{node.get_namespace().rstrip("/")}/sim_node'
        self._status: EpisodeStatus | None = None
        self._values: dict[str, Array] = {}
        self._stamp_ns = 0
        self._facts = Facts(may_command=may_command)
        self._commander = ''
        self._trail: deque[Array] = deque(maxlen=_TRAIL_TICKS)
        self._curves: Curves | None = None
        self._picture: Picture | None = None
        self._is_new = False
        self._kept_goal: Array | None = None
        self._asked_goal: tuple[float, Array] | None = None
        self._publishers: dict[str, Any] = {}
        self._subscriptions: list[Any] = []
        self._actions: dict[type, Callable[[Any], None]] = {
            SetPaused: self._pause,
            StepOnce: self._step,
            Reset: self._reset,
            SetSpeed: self._set_speed,
            ChooseActor: self._choose_actor,
            SetGoal: self._set_goal,
            ReleaseGoal: self._release_goal,
            SetCommanding: self._set_commanding,
            SetCommand: self._command,
            Push: self._push,
        }
        status = topic(_ANY_TASK, 'episode_status')
        self._subscribe(status, status.qos, self._on_status)
        self._subscribe(DIAGNOSTICS, _WATCHING, self._on_diagnostics)
        introduction = topic(_ANY_TASK, 'policy_status')
        self._subscribe(introduction, introduction.qos, self._on_commander)

    @property
    def spec(self) -> TaskSpec | None:
        """The robot's task; None until there is one."""
        status = self._status
        return task_spec(status.task, status.joint_prefix) if status else None

    @property
    def joint_prefix(self) -> str:
        """What the names of the robot's joints begin with."""
        return self._status.joint_prefix if self._status else JOINT_PREFIX

    def picture(self) -> Picture | None:
        """Returns what to show if it has changed since the last call."""
        if not self._is_new or self._status is None:
            return None
        self._is_new = False
        base = self._picture or Picture(self._status.task)
        return dataclasses.replace(base, facts=self._current_facts())

    # What the robot says

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
        except ValueError:
            return
        if self._status is None or self._status.task != status.task:
            self._watch(task_spec(status.task, status.joint_prefix))
        before, self._status = self._status, status
        if self._curves is None or before is None or before.success_rule != status.success_rule:
            self._start_curves(status)
        if status.phase == 'reset':
            self._trail.clear()
            self._values.pop('reward', None)
            self._values.pop('applied_command', None)
            self._facts = dataclasses.replace(self._facts, tick=0, episode_return=0.0)
            if self._kept_goal is not None:
                self._send_goal(self._kept_goal)
        self._is_new = True

    def _watch(self, spec: TaskSpec) -> None:
        for subscription in self._subscriptions:
            self._node.destroy_subscription(subscription)
        self._subscriptions = []
        self._values, self._picture, self._kept_goal = {}, None, None
        names = [*_STATE, *(['object_pose'] if spec.has_object else [])]
        for name in names:
            source = topic(spec, name)
            callback = self._collector(source)
            self._subscriptions.append(self._subscribe(source, _WATCHING, callback, raw=True))
        # Last of the topics that every tick has.
        last = topic(spec, 'is_success')
        self._subscriptions.append(self._subscribe(last, _WATCHING, self._on_tick))

    def _start_curves(self, status: EpisodeStatus) -> None:
        spec = task_spec(status.task)
        rule: Any = status.success_rule
        self._curves = Curves(spec, GoalMetric(spec, success_rule=rule))

    def _collector(self, source: TopicSpec) -> Callable[[bytes], None]:
        codec = TopicCodec(source)

        def collect(data: bytes) -> None:
            try:
                stamp, self._values[source.name] = codec.decode(data)
            except ValueError:
                return
            if source.name == 'joint_states':
                self._stamp_ns = stamp

        return collect

    def _on_tick(self, message: Any) -> None:
        values, status = self._values, self._status
        spec = self.spec
        wanted = ('joint_states', 'desired_goal', 'achieved_goal')
        if status is None or spec is None or any(name not in values for name in wanted):
            return
        joints = len(spec.robot.joints)
        frame = Frame(
            joint_position=values['joint_states'][:joints],
            desired_goal=self._shown_goal(values['desired_goal']),
            achieved_goal=values['achieved_goal'],
            object_pose=values.get('object_pose'),
            is_success=bool(message.data),
        )
        self._trail.append(tracked_position(frame))
        self._add_to_curves(frame)
        reward = float(values['reward'][0]) if 'reward' in values else 0.0
        self._facts = dataclasses.replace(
            self._facts,
            tick=self._facts.tick + 1,
            episode_return=self._facts.episode_return + reward,
        )
        self._picture = self._make_picture(spec, frame)
        self._is_new = True

    def _add_to_curves(self, frame: Frame) -> None:
        curves, values = self._curves, self._values
        if curves is not None:
            reward = float(values['reward'][0]) if 'reward' in values else None
            curves.add(self._stamp_ns * 1e-9, frame, reward, values.get('applied_command'))

    def _make_picture(self, spec: TaskSpec, frame: Frame) -> Picture:
        curves = self._curves
        return Picture(
            task=spec.name,
            frame=frame,
            stamp_ns=self._stamp_ns,
            trail=tuple(self._trail),
            distance=curves.distance if curves else None,
            rotation=curves.rotation if curves else None,
            reward=curves.reward if curves else None,
            commands=curves.commands if curves else None,
            positions=curves.positions if curves else None,
            command=self._values.get('applied_command'),
        )

    def _shown_goal(self, goal: Array) -> Array:
        """The goal the page asked for a moment ago, or the robot's."""
        if self._asked_goal is not None:
            at, asked = self._asked_goal
            if time.monotonic() - at < _GOAL_PATIENCE and not np.allclose(goal, asked):
                return asked
            self._asked_goal = None
        return goal

    def _on_commander(self, message: Any) -> None:
        self._commander = decode_status(message).get('commander', '')
        self._is_new = True

    def _on_diagnostics(self, message: Any) -> None:
        for status in message.status:
            if status.name == self._sim_name:
                values = {pair.key: pair.value for pair in status.values}
                self._facts = dataclasses.replace(
                    self._facts,
                    is_paused=values.get('paused') == 'True',
                    rate=_number(values.get('rate (Hz)')),
                    missed_ticks=int(_number(values.get('missed ticks'))),
                    commander=values.get('commanders', '-'),
                    push_limit=_number(values.get('perturb limit (N)')),
                )
                self._is_new = True

    def _current_facts(self) -> Facts:
        status, facts = self._status, self._facts
        assert status is not None
        spec = task_spec(status.task)
        commander = facts.commander
        if self._commander and 'policy_node' in commander:
            commander = f'{commander}: {self._commander}'
        return dataclasses.replace(
            facts,
            phase=status.phase,
            episode=status.episode,
            seed=status.seed,
            tick=min(facts.tick, spec.episode_ticks),
            ticks=spec.episode_ticks,
            commander=commander,
            actors=(spec.name, 'random', 'resting') if self._policy.is_there() else (),
        )

    # What the page asks for

    def perform(self, request: Request | LatestRequest) -> None:
        """Does what the page asks for, unless it may only watch."""
        if not self._may_command:
            self._notice('this page may only watch (--read-only)')
            return
        self._actions[type(request)](request)
        self._is_new = True

    def _pause(self, request: SetPaused) -> None:
        self._sim.call('pause', 'std_srvs/srv/SetBool', data=request.is_paused)
        self._facts = dataclasses.replace(self._facts, is_paused=request.is_paused)

    def _step(self, request: StepOnce) -> None:
        del request
        self._sim.call('step', 'std_srvs/srv/Trigger')

    def _set_speed(self, request: SetSpeed) -> None:
        self._sim.set_parameter('real_time_factor', float(request.factor))
        self._facts = dataclasses.replace(self._facts, speed=request.factor)

    def _choose_actor(self, request: ChooseActor) -> None:
        self._policy.set_parameter('policy', request.name)

    def _set_goal(self, request: SetGoal) -> None:
        self._kept_goal = request.values if request.is_kept else None
        self._send_goal(request.values)

    def _release_goal(self, request: ReleaseGoal) -> None:
        del request
        self._kept_goal = None
        self._notice('the next episode draws its own goal')

    def _set_commanding(self, request: SetCommanding) -> None:
        self._facts = dataclasses.replace(self._facts, is_commanding=request.is_commanding)
        if not request.is_commanding:
            self._withdraw('commands')

    def _command(self, request: SetCommand) -> None:
        if self._facts.is_commanding:
            self._publish('commands', request.values)

    def _push(self, request: Push) -> None:
        spec = self.spec
        if spec is not None:
            message = build_message(topic(spec, 'perturb'), 0, request.wrench)
            message.header.frame_id = request.body
            self._send('perturb', serialize(topic(spec, 'perturb').type_name, message))

    def _reset(self, request: Reset) -> None:
        seed = request.seed
        if seed is None:
            self._sim.call('reset', 'std_srvs/srv/Trigger')
        else:
            # The seed holds for the next episode, so it has to be there first.
            self._sim.set_parameter(
                'seed', seed, lambda: self._sim.call('reset', 'std_srvs/srv/Trigger')
            )

    def _send_goal(self, goal: Array) -> None:
        self._asked_goal = (time.monotonic(), goal)
        self._publish('set_goal', goal)
        if self._picture is not None and self._picture.frame is not None:
            frame = dataclasses.replace(self._picture.frame, desired_goal=goal)
            self._picture = dataclasses.replace(self._picture, frame=frame)

    def _publish(self, name: str, values: Array) -> None:
        spec = self.spec
        if spec is None:
            return
        # Without a stamp a goal is for the episode that runs when it arrives.
        self._send(name, TopicCodec(topic(spec, name)).encode(0, values))

    def _send(self, name: str, data: bytes) -> None:
        assert self.spec is not None
        target = topic(self.spec, name)
        if name not in self._publishers:
            self._publishers[name] = self._node.create_publisher(
                ros_message_class(target.type_name), target.name, rclpy_profile(target.qos)
            )
        self._publishers[name].publish(data)

    def _withdraw(self, name: str) -> None:
        """Leaves a topic: who publishes commands counts as a commander."""
        publisher = self._publishers.pop(name, None)
        if publisher is not None:
            self._node.destroy_publisher(publisher)

    def _subscribe(
        self, source: TopicSpec, qos: QosSpec, callback: Callable[[Any], None], raw: bool = False
    ) -> Any:
        message_class = ros_message_class(source.type_name)
        profile = rclpy_profile(qos)
        return self._node.create_subscription(
            message_class, source.name, callback, profile, raw=raw
        )

    def _notice(self, text: str) -> None:
        self._facts = dataclasses.replace(self._facts, notice=text)
        self._is_new = True


def _number(text: str | None) -> float:
    try:
        return float(text or 0.0)
    except ValueError:
        return 0.0
