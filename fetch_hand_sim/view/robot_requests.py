"""Send requests of the page to a running robot, over public topics, services and parameters."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from rclpy.node import Node

from fetch_hand_sim.episodes.runner import bounded_wrench
from fetch_hand_sim.view.picture import Facts
from fetch_hand_sim.view.requests import (
    ChooseActor,
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
from fetch_hand_sim.watch.replay_watch import Replay
from msgs_spec.arrays import Array
from msgs_spec.codecs import TopicCodec, build_message
from msgs_spec.schemas import serialize
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import PAUSE, topic
from node_runtime.ros import open_publisher, ros_service_class

_SET_PARAMETERS = 'rcl_interfaces/srv/SetParameters'
_GET_PARAMETERS = 'rcl_interfaces/srv/GetParameters'
_TRIGGER = 'std_srvs/srv/Trigger'
# Seconds to wait for the answer of a node before the next request.
_ANSWER_TIMEOUT = 3.0
# Seconds for which a new goal is shown before the robot confirms it.
_GOAL_TIMEOUT = 0.5
_OF_A_REPLAY = (SetPaused, SetSpeed, SetCommanding)


class RemoteNode:
    """Calls services of another node without waiting for the responses.

    Args:
        name: Name of the other node, fully qualified or relative to the namespace of `node`.
        notice: Called with a line for the user, for example if a call is rejected or not possible.
    """

    def __init__(self, node: Node, name: str, notice: Callable[[str], None]) -> None:
        self._node = node
        self._name = name
        self._notice = notice
        self._clients: dict[str, Any] = {}
        self._asked: dict[str, tuple[Any, float]] = {}

    def is_there(self) -> bool:
        """Return whether the services of the other node are available."""
        return bool(self._client('set_parameters', _SET_PARAMETERS).service_is_ready())

    def call(
        self,
        service: str,
        type_name: str,
        then: Callable[[], None] | None = None,
        **fields: Any,
    ) -> None:
        """Call a service with request `fields`; call `then` if its response has `success`.

        The `message` of the response, or that the node does not answer, goes to `notice`.
        """

        def answered(response: Any) -> None:
            self._notice(response.message)
            if response.success and then is not None:
                then()

        self._call(service, type_name, fields, answered)

    def get_parameter(self, name: str, then: Callable[[Any], None]) -> None:
        """Request a parameter; `then` receives its value, if it is set and the node answers."""
        from rclpy.parameter import parameter_value_to_python

        def answered(future: Any) -> None:
            values = [parameter_value_to_python(each) for each in future.result().values]
            for value in values:
                if value is not None:
                    then(value)

        client = self._client('get_parameters', _GET_PARAMETERS)
        if client.service_is_ready() and not self._awaits(name):
            request = ros_service_class(_GET_PARAMETERS).Request(names=[name])
            future = client.call_async(request)
            self._asked[name] = future, time.monotonic()
            future.add_done_callback(answered)

    def set_parameter(self, name: str, value: str | int | float, then: Callable[[], None]) -> None:
        """Set a parameter; call `then` if the node accepts the value, `notice` if it does not."""
        from rclpy.parameter import Parameter

        def answered(response: Any) -> None:
            result = response.results[0]
            if not result.successful:
                self._notice(f'{self._name} refuses {name}: {result.reason}')
            else:
                then()

        parameter = Parameter(name, value=value).to_parameter_msg()
        self._call('set_parameters', _SET_PARAMETERS, {'parameters': [parameter]}, answered)

    def close(self) -> None:
        """Destroy the clients; pending answers are dropped."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients.clear()
        self._asked.clear()

    def _awaits(self, name: str) -> bool:
        """Return whether the request for parameter `name` is unanswered and less than 3 s old."""
        future, asked = self._asked.get(name, (None, 0.0))
        is_recent = time.monotonic() - asked < _ANSWER_TIMEOUT
        return future is not None and not future.done() and is_recent

    def _call(
        self,
        service: str,
        type_name: str,
        fields: dict[str, Any],
        answered: Callable[[Any], None],
    ) -> None:
        client = self._client(service, type_name)
        if not client.service_is_ready():
            self._notice(f'{self._name} does not answer')
            return
        request = ros_service_class(type_name).Request(**fields)
        client.call_async(request).add_done_callback(lambda future: answered(future.result()))

    def _client(self, service: str, type_name: str) -> Any:
        if service not in self._clients:
            name = service if service.startswith('/') else f'{self._name}/{service}'
            self._clients[service] = self._node.create_client(ros_service_class(type_name), name)
        return self._clients[service]


class RobotRequests:
    """Sends requests of the page to the simulator node, the policy node or a replay node.

    Args:
        node: Sends the requests; its namespace is that of the simulator and the policy node.
        tell: Called with keyword arguments: changed fields of `Facts`, the state shown by the page.
    """

    def __init__(self, node: Node, tell: Callable[..., None]) -> None:
        self._node = node
        self._tell = tell
        self._sim = RemoteNode(node, 'sim_node', self._notice)
        self._policy = RemoteNode(node, 'policy_node', self._notice)
        self._replay: tuple[Replay, RemoteNode] | None = None
        self._spec: TaskSpec | None = None
        self._kept_goal: Array | None = None
        self._asked_goal: tuple[float, Array] | None = None
        self._publishers: dict[str, Any] = {}

    @property
    def has_policy(self) -> bool:
        """True if a policy node runs."""
        return self._policy.is_there()

    def take_task(self, spec: TaskSpec) -> None:
        """Store the robot's task; a new one closes the publishers, whose types may differ."""
        if self._spec is not None and self._spec.name != spec.name:
            for name in list(self._publishers):
                self._withdraw(name)
        self._spec = spec

    def forget_goal(self) -> None:
        """Drop the goal that the user has set."""
        self._kept_goal = self._asked_goal = None

    def take_replay(self, replay: Replay | None) -> None:
        """Control pause and speed of the node `replay` from now on, or of the robot if None."""
        if self._replay is not None:
            self._replay[1].close()
        self._replay = None
        if replay is not None:
            self._replay = replay, RemoteNode(self._node, replay.name, self._notice)

    def begin_episode(self) -> None:
        """Set the goal again in a new episode, if the user has chosen to keep it."""
        if self._kept_goal is not None and self._replay is None:
            self._send_goal(self._kept_goal)

    def read_speed(self) -> None:
        """Request the speed, a multiple of real time; `tell` receives the answer as `speed`."""
        self._time.get_parameter(self._speed_name, lambda value: self._tell(speed=value))

    def read_actor(self) -> None:
        """Request the name of the policy node's actor; `tell` receives the answer as `actor`."""
        if self._spec is not None:
            # An empty parameter means the shipped actor of the task.
            shipped = self._spec.name
            self._policy.get_parameter('policy', lambda name: self._tell(actor=name or shipped))

    def perform(self, request: Request, facts: Facts) -> None:
        """Send a request to the simulator, policy or replay node; ignore requests about files.

        Commands are sent only if `facts.is_commanding`. The force of pushes is limited to
        `facts.push_limit`, N. Requests are ignored before `take_task`, or if `fits` is False.
        """
        if self._spec is None or not self.fits(request):
            return
        if self._replay is not None and not isinstance(request, _OF_A_REPLAY):
            self._notice('a replay can only be paused and change its speed')
            return
        match request:
            case SetPaused() | StepOnce() | Reset() | SetSpeed():
                self._control_time(request)
            case ChooseActor():
                taken = partial(self._tell, actor=request.name, notice=f'policy: {request.name}')
                self._policy.set_parameter('policy', request.name, taken)
            case SetGoal():
                self._kept_goal = request.values if request.is_kept else None
                self._send_goal(request.values)
            case ReleaseGoal():
                self._kept_goal = None
                self._notice('the next episode draws its own goal')
            case SetCommanding():
                self._set_commanding(request.is_commanding)
            case SetCommand() if facts.is_commanding:
                self._publish('commands', request.values)
            case Push():
                self._push(request, facts.push_limit)

    def _control_time(self, request: SetPaused | StepOnce | Reset | SetSpeed) -> None:
        match request:
            case SetPaused():
                service = 'pause' if self._replay is None else self._replay[0].pause
                paused = partial(self._tell, is_paused=request.is_paused)
                self._time.call(service, PAUSE.type_name, paused, data=request.is_paused)
            case StepOnce():
                self._sim.call('step', _TRIGGER)
            case Reset(seed=seed):
                reset = partial(self._sim.call, 'reset', _TRIGGER)
                if seed is None:
                    reset()
                else:
                    # The seed is for the next episode, so set it before the reset.
                    self._sim.set_parameter('seed', seed, reset)
            case SetSpeed():
                factor, name = float(request.factor), self._speed_name
                taken = partial(self._tell, speed=factor, notice=f'{name}: {factor:g}')
                self._time.set_parameter(name, factor, taken)

    def fits(self, request: Request) -> bool:
        """Return whether a goal or command has the task's size; True for other requests."""
        if self._spec is None or not isinstance(request, SetGoal | SetCommand):
            return True
        name = 'set_goal' if isinstance(request, SetGoal) else 'commands'
        return request.values.size == topic(self._spec, name).size

    def shown_goal(self, goal: Array) -> Array:
        """Return the goal (goal size,) to draw; `goal` is the one that the robot publishes.

        A goal that the page has sent is drawn until the robot publishes it, at most for 0.5 s.
        """
        if self._asked_goal is not None:
            at, asked = self._asked_goal
            if time.monotonic() - at < _GOAL_TIMEOUT and not np.allclose(goal, asked):
                return asked
            self._asked_goal = None
        return goal

    @property
    def _time(self) -> RemoteNode:
        """The node with pause and speed: the replay node if there is one, else `sim_node`."""
        return self._sim if self._replay is None else self._replay[1]

    @property
    def _speed_name(self) -> str:
        return 'real_time_factor' if self._replay is None else 'rate'

    def _set_commanding(self, is_commanding: bool) -> None:
        self._tell(is_commanding=is_commanding)
        if not is_commanding:
            self._withdraw('commands')

    def _push(self, request: Push, limit: float) -> None:
        assert self._spec is not None
        if not limit:
            self._notice('pushes are off; start the robot with perturb_limit:=10.0 (N)')
            return
        target = topic(self._spec, 'perturb')
        wrench = bounded_wrench(request.wrench, limit)
        message = build_message(target, 0, wrench)
        message.header.frame_id = request.body
        self._send('perturb', serialize(target.type_name, message))

    def _send_goal(self, goal: Array) -> None:
        self._asked_goal = (time.monotonic(), goal)
        self._publish('set_goal', goal)

    def _publish(self, name: str, values: Array) -> None:
        assert self._spec is not None
        # A goal without stamp is for the episode that runs when it arrives.
        self._send(name, TopicCodec(topic(self._spec, name)).encode(0, values))

    def _send(self, name: str, data: bytes) -> None:
        assert self._spec is not None
        target = topic(self._spec, name)
        if name not in self._publishers:
            self._publishers[name] = open_publisher(self._node, target)
        self._publishers[name].publish(data)

    def _withdraw(self, name: str) -> None:
        """Destroy the publisher of topic `name`; a node with one for `commands` is a commander."""
        publisher = self._publishers.pop(name, None)
        if publisher is not None:
            self._node.destroy_publisher(publisher)

    def _notice(self, text: str) -> None:
        self._tell(notice=text)
