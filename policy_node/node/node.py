"""The ROS node around a `Responder`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.subscription import Subscription

from msgs_spec.codecs import build_status, decode_status, message_stamp
from msgs_spec.parameters import POLICY_NODE
from msgs_spec.schemas import deserialize, require_short, serialize
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import DIAGNOSTICS, STATE, TopicSpec, topic
from node_runtime.command_line import UsageError
from node_runtime.diagnostics import REPORT_PERIOD, encode_reports, next_report
from node_runtime.event_loop import BEAT, EventLoop
from node_runtime.node_main import NodeFailure, StopSignals
from node_runtime.ros import open_publisher, seldom, subscribe
from node_runtime.ros_parameters import declare_parameters, set_callback
from policy_node.node import NODE_NAME
from policy_node.node.health import Health, Pace, read_pace
from policy_node.node.responder import Responder
from policy_node.policies.loading import TaskMissing, load_policy
from policy_node.policies.policy import LoadedPolicy

_WARN_PERIOD = 1.0
# Seconds that discovery may take before reports name other robots or missing topics.
_PATIENCE = 3.0
_SERVED_AT_ONCE = 1000
# Seconds for which the pace of a robot is valid; robots publish it once a second.
_PACE_HOLDS = 3.0
# Number of rejected robots to remember.
_REMEMBERED = 7
_ANY_TASK = next(iter(TASKS.values()))


class PolicyNode(Node):
    """Wait for a robot, check that the policy fits it, then answer every tick with a command.

    A robot that restarts with another task or frequency counts as a new robot.

    Raises:
        UsageError: If a parameter is invalid or the policy cannot be loaded.
    """

    def __init__(self) -> None:
        super().__init__(NODE_NAME, start_parameter_services=False)
        self._settings = declare_parameters(self, POLICY_NODE)
        self._loaded = self._load_ahead()
        self._status: EpisodeStatus | None = None
        # Further robots that the policy does not fit.
        self._refused: list[EpisodeStatus] = []
        self._status_stamp = 0
        self._responder: Responder | None = None
        self._answered_status: EpisodeStatus | None = None
        self._commands: Publisher | None = None
        self._of_robot: list[Publisher | Subscription] = []
        self._pace: Pace | None = None
        self._pace_until = -math.inf
        self._is_replaced = False
        self._health = Health(self.get_fully_qualified_name())
        self._diagnostics = open_publisher(self, DIAGNOSTICS)
        self._report_due = time.monotonic() + REPORT_PERIOD
        self._elsewhere_from = time.monotonic() + _PATIENCE
        self._status_name = self.resolve_topic_name('episode_status')
        status = topic(_ANY_TASK, 'episode_status')
        subscribe(self, status, self._reader(status, self._on_status), raw=True)
        subscribe(self, DIAGNOSTICS, self._reader(DIAGNOSTICS, self._on_diagnostics), raw=True)
        self.add_on_set_parameters_callback(self._take_policy)

    def run(self, stop: StopSignals) -> None:
        """Answer robots until `stop` is set.

        Raises:
            NodeFailure: If no policy is found, or the policy does not fit the robot.
        """
        loop = EventLoop(self)
        self.get_logger().info(f'waiting for a robot on {self._status_name}')
        try:
            while not stop:
                loop.wait(BEAT)
                if self._has_robot_changed() or self._is_replaced:
                    self._leave()
                    # Releases the topics; the next robot may have other types.
                    loop.serve_pending(_SERVED_AT_ONCE)
                if self._responder is not None:
                    self._answer(self._responder, loop)
                elif self._status is not None:
                    self._start(self._status, loop, stop)
                self._report_when_due()
        finally:
            loop.close()

    def _answer(self, responder: Responder, loop: EventLoop) -> None:
        if responder.is_due:
            # Prefer newer ticks if the robot is faster than the policy.
            loop.serve_pending(_SERVED_AT_ONCE)
        try:
            responder.answer()
        except ValueError as error:
            self.get_logger().warning(f'no command: {error}', **seldom(_WARN_PERIOD))
        responder.send_unsent()

    def _load_ahead(self) -> LoadedPolicy | None:
        """Load the policy before a robot appears; None if that needs the task of the robot."""
        settings = self._settings
        try:
            return load_policy(
                settings['policy'], settings['task'] or None, trust=settings['trust']
            )
        except TaskMissing:
            return None
        except ValueError as error:
            raise UsageError(str(error)) from None

    def _start(self, status: EpisodeStatus, loop: EventLoop, stop: StopSignals) -> None:
        """Subscribe to the state of the robot, wait for its publishers, then advertise `commands`.

        If `stop` is set, or the robot or policy changes, return without advertising `commands`.

        Raises:
            NodeFailure: If no policy is found, or the policy does not fit the robot.
        """
        try:
            policy = self._loaded = self._load_for(status)
            responder = Responder(policy, status, self._send)
        except ValueError as error:
            raise NodeFailure(str(error)) from None
        self._responder, self._answered_status = responder, status
        state = [
            subscribe(self, source, self._receiver(responder, source.name), qos=STATE, raw=True)
            for source in responder.topics
        ]
        self._of_robot += state
        began = time.monotonic()
        names = [each.topic_name for each in state]
        while missing := [name for name in names if not self.count_publishers(name)]:
            loop.wait(BEAT)
            if stop or self._has_robot_changed() or self._is_replaced:
                return
            self._report_when_due(missing if time.monotonic() > began + _PATIENCE else ())
        self._announce(policy)
        # Created last: for the robot, this publisher means that the policy is ready.
        self._commands = open_publisher(self, topic(task_spec(policy.task), 'commands'))
        self._of_robot.append(self._commands)
        self._health.start(responder, status, time.monotonic())
        self.get_logger().info(f'{policy.task}: commands come from {policy.description}')

    def _load_for(self, status: EpisodeStatus) -> LoadedPolicy:
        """Return the loaded policy if it has the task of the robot, else load one for this task.

        Raises:
            ValueError: If no policy for this task is found, or parameter `task` names another task.
        """
        wanted, name = self._settings['task'], self._settings['policy']
        if wanted and wanted != status.task:
            raise ValueError(f'the robot has task {status.task}, not {wanted}')
        if self._loaded is None or self._loaded.task != status.task:
            return load_policy(name, status.task, trust=self._settings['trust'])
        return self._loaded

    def _has_robot_changed(self) -> bool:
        before, now = self._answered_status, self._status
        return before is not None and now is not None and not now.is_of_same_robot(before)

    def _take_policy(self, parameters: list[Parameter]) -> SetParametersResult:
        """Return whether the change of parameters is accepted; a new `policy` is loaded first."""
        result = set_callback(POLICY_NODE)(parameters)
        for parameter in parameters:
            if parameter.name != 'policy' or not result.successful:
                continue
            try:
                self._loaded, self._status = self._load_for_one(parameter.value)
            except ValueError as error:
                return SetParametersResult(successful=False, reason=str(error))
            self._settings['policy'] = parameter.value
            self._refused.clear()
            self._is_replaced = self._answered_status is not None
        return result

    def _load_for_one(self, name: str) -> tuple[LoadedPolicy | None, EpisodeStatus | None]:
        """Load the policy `name`; return the policy and the last status of a robot that it fits.

        While no robot runs, the result is (policy, None), or (None, None) if loading the policy
        needs the task of a robot.

        Raises:
            ValueError: If the policy cannot be loaded, or fits no robot.
        """
        is_there = self.count_publishers(self._status_name) > 0
        known: list[EpisodeStatus | None] = [self._status] if self._status else []
        # If the robot has left, a robot with another task may follow.
        robots = [*known, *self._refused] if known and is_there else [None]
        problems = []
        for status in robots:
            task = status.task if status else self._settings['task'] or None
            try:
                loaded = load_policy(name, task, trust=self._settings['trust'])
                if status is not None:
                    loaded.require_rate(status.control_hz)
            except TaskMissing:
                return None, status
            except ValueError as error:
                problems.append(error)
            else:
                return loaded, status
        raise problems[0]

    def _leave(self) -> None:
        """Close the topics of the robot, before the node changes its policy or robot."""
        before, now = self._answered_status, self._status
        if not self._is_replaced:
            assert before is not None and now is not None
            old, new = (f'{each.task} at {each.control_hz:g} Hz' for each in (before, now))
            if old == new:
                old, new = (f'joint_prefix {each.joint_prefix!r}' for each in (before, now))
            self.get_logger().info(f'the robot changed from {old} to {new}')
        self._is_replaced = False
        for each in self._of_robot:
            if isinstance(each, Publisher):
                self.destroy_publisher(each)
            else:
                self.destroy_subscription(each)
        self._of_robot.clear()
        self._commands = self._responder = self._answered_status = None
        self._health.stop()

    def _announce(self, policy: LoadedPolicy) -> None:
        """Publish name and hash of the policy with the last status's stamp; the robot logs them."""
        status = topic(task_spec(policy.task), 'policy_status')
        values = {'commander': policy.description, 'checkpoint_sha256': policy.sha256}
        message = build_status(status, self._status_stamp, NODE_NAME, values)
        publisher = open_publisher(self, status)
        self._of_robot.append(publisher)
        publisher.publish(serialize(status.type_name, message))

    def _reader(self, spec: TopicSpec, callback: Callable[[Any], None]) -> Callable[[bytes], None]:
        """Return a callback that decodes raw messages for `callback`; it drops invalid ones."""

        def on_message(data: bytes) -> None:
            try:
                require_short(data)
                message = deserialize(spec.type_name, data)
            except ValueError as error:
                if spec is not DIAGNOSTICS:
                    line = f'{spec.name} ignored: {error}'
                    self.get_logger().warning(line, **seldom(_WARN_PERIOD))
                return
            callback(message)

        return on_message

    def _receiver(self, responder: Responder, name: str) -> Callable[[bytes], None]:
        def on_message(data: bytes) -> None:
            try:
                require_short(data)
                responder.receive(name, data)
            except ValueError as error:
                self.get_logger().warning(f'state dropped: {error}', **seldom(_WARN_PERIOD))

        return on_message

    def _send(self, data: bytes) -> bool:
        """Publish a command if there is a subscriber; return whether it was published."""
        if self._commands is None or not self._commands.get_subscription_count():
            return False
        self._commands.publish(data)
        return True

    def _on_status(self, message: Any) -> None:
        try:
            status = EpisodeStatus.from_values(decode_status(message))
            task_spec(status.task)
            stamp = message_stamp(message)
        except ValueError as error:
            self.get_logger().warning(f'ignored: {error}', **seldom(_WARN_PERIOD))
            return
        if not self._may_follow(status):
            line = f'ignored: another robot here, {status.task} at {status.control_hz:g} Hz'
            self.get_logger().warning(line, **seldom(_WARN_PERIOD))
            return
        # A robot that was started again, or an episode that is replayed again.
        if self._responder is not None and (
            status.phase == 'waiting' or stamp < self._status_stamp
        ):
            self._responder.forget()
        self._status, self._status_stamp = status, stamp
        if self._responder is not None:
            self._responder.note_phase(status.phase, stamp)

    def _may_follow(self, status: EpisodeStatus) -> bool:
        """Return whether to follow the robot that published `status`.

        True for the first robot, for the present one, and for the only one on the topic, which has
        replaced the present one. A second robot needs a policy of its task and frequency.
        """
        known = self._status
        if known is None or status.is_of_same_robot(known):
            return True
        if self.count_publishers(self._status_name) <= 1:
            # The robot itself has changed.
            return True
        if any(status.is_of_same_robot(each) for each in self._refused):
            return False
        try:
            self._load_for(status).require_rate(status.control_hz)
        except ValueError as error:
            self._refused = [*self._refused[-_REMEMBERED:], status]
            self.get_logger().warning(str(error))
            return False
        return True

    def _on_diagnostics(self, message: Any) -> None:
        pace = read_pace(message, self.get_namespace())
        if pace is not None:
            self._pace, self._pace_until = pace, time.monotonic() + _PACE_HOLDS

    def _report_when_due(self, missing: Sequence[str] = ()) -> None:
        now = time.monotonic()
        if now < self._report_due:
            return
        self._report_due = next_report(self._report_due, now)
        robots = self.count_publishers(self._status_name)
        if not robots and self._responder is not None:
            # The next robot begins anew, even with the same first stamp.
            self._responder.forget()
        elsewhere = [] if robots or now < self._elsewhere_from else self._robots_elsewhere()
        pace = self._pace if now < self._pace_until else None
        state = [each for each in self._of_robot if isinstance(each, Subscription)]
        publishers = {each.topic_name: self.count_publishers(each.topic_name) for each in state}
        report = self._health.report(now, robots, pace, elsewhere, missing, publishers)
        self._diagnostics.publish(encode_reports(report))
        for line in self._health.news(report):
            self.get_logger().warning(line)

    def _robots_elsewhere(self) -> list[str]:
        """Return the sorted namespaces, such as `/left`, in which a robot publishes its status."""
        wanted = topic(_ANY_TASK, 'episode_status')
        found = []
        for name, types in self.get_topic_names_and_types():
            namespace, _, last = name.rpartition('/')
            if last == wanted.name and wanted.type_name in types and self.count_publishers(name):
                found.append(namespace or '/')
        return sorted(found)
