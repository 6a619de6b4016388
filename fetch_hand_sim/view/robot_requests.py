"""What the page asks of a running robot: topics, services and parameters that anybody may use."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node

from fetch_hand_sim.episodes.perturbations import bounded_wrench
from fetch_hand_sim.view.remote_node import RemoteNode
from fetch_hand_sim.view.replay_watch import Replay
from fetch_hand_sim.view.requests import (
    ChooseActor,
    LatestRequest,
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
from msgs_spec.arrays import Array
from msgs_spec.cdr import TopicCodec
from msgs_spec.codecs import build_message
from msgs_spec.schemas import serialize
from msgs_spec.services import PAUSE
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topic
from node_runtime.ros import rclpy_profile, ros_message_class

# Seconds a goal is shown before the robot confirms it.
_GOAL_PATIENCE = 0.5
# What a replay can do, and what is the page's own affair.
_OF_A_REPLAY = (SetPaused, SetSpeed, SetCommanding)


class RobotRequests:
    """Passes on what the page asks for to the nodes in the namespace of ours.

    Args:
        node: Of this process.
        tell: Gets changed fields of `Facts`, by name.

    Attributes:
        push_limit: Largest force that the robot takes, N; 0 for none.
    """

    def __init__(self, node: Node, tell: Callable[..., None]) -> None:
        self._node = node
        self._tell = tell
        self._sim = RemoteNode(node, 'sim_node', self._notice)
        self._policy = RemoteNode(node, 'policy_node', self._notice)
        self._replay: tuple[Replay, RemoteNode] | None = None
        self._spec: TaskSpec | None = None
        self.push_limit = 0.0
        self._is_commanding = False
        self._kept_goal: Array | None = None
        self._asked_goal: tuple[float, Array] | None = None
        self._publishers: dict[str, Any] = {}
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

    @property
    def has_policy(self) -> bool:
        """Whether there is a policy to talk to."""
        return self._policy.is_there()

    def take_task(self, spec: TaskSpec) -> None:
        """Takes the task of the robot; what was asked of another one is forgotten."""
        if self._spec is not None and self._spec.name != spec.name:
            self._kept_goal = self._asked_goal = None
            # Goals of another task may have another type.
            for name in list(self._publishers):
                self._withdraw(name)
            self._is_commanding = False
            self._tell(is_commanding=False)
        self._spec = spec

    def take_replay(self, replay: Replay | None) -> None:
        """Takes who replays where a robot would be, or None: it is asked instead of the robot."""
        if self._replay is not None:
            self._replay[1].close()
        self._replay = None
        if replay is not None:
            self._replay = replay, RemoteNode(self._node, replay.name, self._notice)

    def begin_episode(self) -> None:
        """Sends an episode that has begun the goal that people keep."""
        if self._kept_goal is not None and self._replay is None:
            self._send_goal(self._kept_goal)

    def read_speed(self) -> None:
        """Asks how fast time shall go; the answer is told when it comes."""
        self._time.get_parameter(self._speed_name, lambda value: self._tell(speed=value))

    def read_actor(self) -> None:
        """Asks who acts; the answer is told when it comes."""
        if self._spec is not None:
            # Without a name it is the one that comes with the task.
            shipped = self._spec.name
            self._policy.get_parameter('policy', lambda name: self._tell(actor=name or shipped))

    def perform(self, request: Request | LatestRequest) -> None:
        """Does what the page asks for; what only files understand is nothing to a robot."""
        action = self._actions.get(type(request))
        if action is None or self._spec is None or not self.fits(request):
            return
        if self._replay is not None and not isinstance(request, _OF_A_REPLAY):
            self._notice('a replay stops, goes on and changes its speed, no more')
            return
        action(request)

    def fits(self, request: Request | LatestRequest) -> bool:
        """Whether it has the size that the robot of now takes; there may have been another."""
        if self._spec is None or not isinstance(request, SetGoal | SetCommand):
            return True
        name = 'set_goal' if isinstance(request, SetGoal) else 'commands'
        return request.values.size == topic(self._spec, name).size

    def shown_goal(self, goal: Array) -> Array:
        """The goal (goal size,) the page asked for a moment ago, or the robot's."""
        if self._asked_goal is not None:
            at, asked = self._asked_goal
            if time.monotonic() - at < _GOAL_PATIENCE and not np.allclose(goal, asked):
                return asked
            self._asked_goal = None
        return goal

    @property
    def _time(self) -> RemoteNode:
        """The node that makes time go on."""
        return self._sim if self._replay is None else self._replay[1]

    @property
    def _speed_name(self) -> str:
        return 'real_time_factor' if self._replay is None else 'rate'

    def _pause(self, request: SetPaused) -> None:
        service = 'pause' if self._replay is None else self._replay[0].pause
        paused = partial(self._tell, is_paused=request.is_paused)
        self._time.call(service, PAUSE.type_name, paused, data=request.is_paused)

    def _step(self, request: StepOnce) -> None:
        del request
        self._sim.call('step', 'std_srvs/srv/Trigger')

    def _reset(self, request: Reset) -> None:
        reset = partial(self._sim.call, 'reset', 'std_srvs/srv/Trigger')
        if request.seed is None:
            reset()
        else:
            # The seed holds for the next episode, so it has to be there first.
            self._sim.set_parameter('seed', request.seed, reset)

    def _set_speed(self, request: SetSpeed) -> None:
        factor = float(request.factor)
        taken = partial(self._tell, speed=factor, notice=f'{self._speed_name}: {factor:g}')
        self._time.set_parameter(self._speed_name, factor, taken)

    def _choose_actor(self, request: ChooseActor) -> None:
        taken = partial(self._tell, actor=request.name, notice=f'policy: {request.name}')
        self._policy.set_parameter('policy', request.name, taken)

    def _set_goal(self, request: SetGoal) -> None:
        self._kept_goal = request.values if request.is_kept else None
        self._send_goal(request.values)

    def _release_goal(self, request: ReleaseGoal) -> None:
        del request
        self._kept_goal = None
        self._notice('the next episode draws its own goal')

    def _set_commanding(self, request: SetCommanding) -> None:
        self._is_commanding = request.is_commanding
        self._tell(is_commanding=request.is_commanding)
        if not request.is_commanding:
            self._withdraw('commands')

    def _command(self, request: SetCommand) -> None:
        if self._is_commanding:
            self._publish('commands', request.values)

    def _push(self, request: Push) -> None:
        assert self._spec is not None
        if not self.push_limit:
            self._notice('pushes are off; start the robot with perturb_limit:=10.0 (N)')
            return
        target = topic(self._spec, 'perturb')
        wrench = bounded_wrench(request.wrench, self.push_limit)
        message = build_message(target, 0, wrench)
        message.header.frame_id = request.body
        self._send('perturb', serialize(target.type_name, message))

    def _send_goal(self, goal: Array) -> None:
        self._asked_goal = (time.monotonic(), goal)
        self._publish('set_goal', goal)

    def _publish(self, name: str, values: Array) -> None:
        assert self._spec is not None
        # Without a stamp a goal is for the episode that runs when it arrives.
        self._send(name, TopicCodec(topic(self._spec, name)).encode(0, values))

    def _send(self, name: str, data: bytes) -> None:
        assert self._spec is not None
        target = topic(self._spec, name)
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

    def _notice(self, text: str) -> None:
        self._tell(notice=text)
