"""The ROS node that publishes the messages of a logged episode again, at any speed."""

from __future__ import annotations

import math
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import SetBool

from fetch_hand_sim.replay_node import NODE_NAME
from fetch_hand_sim.replay_node.schedule import Playhead, ReplayMessage, ReplaySchedule
from msgs_spec.parameters import REPLAY_NODE
from node_runtime.command_line import UsageError
from node_runtime.event_loop import BEAT, EventLoop
from node_runtime.node_main import StopSignals
from node_runtime.ros import (
    DISCOVERY_TIME,
    SubscriberWatch,
    await_acknowledgements,
    count_publishers,
    full_name,
    open_publisher,
)
from node_runtime.ros_parameters import declare_parameters, set_callback

# Seconds of a stall after which a replay continues where it was, without catching up.
_LONGEST_STALL = 0.5
_CLOCK = '/clock'


class ReplayNode(Node):
    """Publishes a logged episode, with the settings `msgs_spec.parameters.REPLAY_NODE`."""

    def __init__(self) -> None:
        super().__init__(NODE_NAME, start_parameter_services=False)
        self._created_at = time.monotonic()
        self._settings = declare_parameters(self, REPLAY_NODE)
        self._schedule = self._read_schedule()
        self._start_ns = self._schedule.start_ns + round(self._settings['start_offset'] * 1e9)
        if self._start_ns > self._schedule.end_ns:
            length = (self._schedule.end_ns - self._schedule.start_ns) / 1e9
            raise ValueError(
                f'start_offset: {self._settings["start_offset"]} given; allowed: up to {length:.3f}'
            )
        # In a loop, the last tick lasts as long as the others.
        self._end_ns = self._schedule.end_ns + self._schedule.period_ns
        self._publishers_by_topic = {name: self._open(name) for name in self._schedule.topics}
        self._next = 0
        self._last_clock: bytes | None = None
        self._is_paused = self._settings['start_paused']
        self._playhead = Playhead(self._start_ns, self._rate, time.monotonic())
        self.create_service(SetBool, '~/pause', self._on_pause)
        self.add_on_set_parameters_callback(set_callback(REPLAY_NODE))
        self.add_post_set_parameters_callback(self._apply_changes)

    @property
    def _rate(self) -> float:
        return 0.0 if self._is_paused else float(self._settings['rate'])

    def _read_schedule(self) -> ReplaySchedule:
        path = self._settings['path']
        if not path:
            raise ValueError('path is missing; allowed: a bag directory or an MCAP file')
        names = [name.strip() for name in self._settings['topics'].split(',') if name.strip()]
        return ReplaySchedule(Path(path), names, self._settings['inputs'])

    def _open(self, name: str) -> Publisher:
        spec = self._schedule.topics[name]
        return open_publisher(self, replace(spec, name=self._name_here(name)))

    def _name_here(self, name: str) -> str:
        """Return a recorded topic name with this node's namespace in place of the recorded one.

        `/clock` and names outside the recorded namespace are returned unchanged. If this node has
        no namespace, all names are returned unchanged.
        """
        namespace, recorded = self.get_namespace().rstrip('/'), f'{self._schedule.namespace}/'
        if not namespace or name == _CLOCK or not name.startswith(recorded):
            return name
        return f'{namespace}/{name.removeprefix(recorded)}'

    def run(self, stop: StopSignals) -> None:
        """Publish until a signal arrives or, unless the setting `loop` is on, the episode ends.

        Raise UsageError if a topic has another publisher and the setting `force` is off.
        """
        loop = EventLoop(self)
        self.get_logger().info(self._description())
        try:
            self._require_free_topics(loop, stop)
            self._wait_for_commander(loop, stop)
            self._begin()
            while not stop and not self._is_over():
                self._serve(loop)
                self._publish_due()
        finally:
            await_acknowledgements(self._publishers_by_topic.values())
            loop.close()

    def _require_free_topics(self, loop: EventLoop, stop: StopSignals) -> None:
        """Wait for discovery; UsageError if a topic has another publisher and `force` is off."""
        if self._settings['force']:
            return
        while not stop and time.monotonic() < self._created_at + DISCOVERY_TIME:
            loop.wait(BEAT)
        for name in self._publishers_by_topic:
            topic = self.resolve_topic_name(self._name_here(name))
            found = [
                full_name(info.node_namespace, info.node_name)
                for info in self.get_publishers_info_by_topic(topic)
            ]
            # Another replay has the same name as this one.
            if self.get_fully_qualified_name() in found:
                found.remove(self.get_fully_qualified_name())
            if found:
                raise UsageError(
                    f'{topic} is already published by {", ".join(sorted(found))}; stop that node, '
                    'publish elsewhere (-r __ns:=/replay -r /clock:=/replay/clock) or set '
                    'force:=true'
                )

    def _description(self) -> str:
        """Return a log line with the episode, the speed and the namespace of the topics."""
        seconds = (self._schedule.end_ns - self._start_ns) / 1e9
        parts = [
            f'{self._settings["path"]}: {seconds:.2f} s, at {self._settings["rate"]:g} x real time',
            f'topics in {self._name_here(self._schedule.namespace + "/").rstrip("/") or "/"}',
        ]
        if self._settings['wait_for_commands']:
            parts.append('waits for commands')
        if self._settings['start_paused']:
            parts.append('paused until ~/pause is called with false')
        return '; '.join(parts)

    def _wait_for_commander(self, loop: EventLoop, stop: StopSignals) -> None:
        """Publish the latched topics; with `wait_for_commands`, wait until a policy is connected.

        A policy node connects after it has read its task from the latched topics. Without the
        wait, it would miss the first observation.
        """
        self._publish_latched()
        if not self._settings['wait_for_commands']:
            return
        listeners = SubscriberWatch(self, self._publishers_by_topic.values())
        recorded = f'{self._schedule.namespace}/commands'
        commands, own = self._name_here(recorded), int(recorded in self._publishers_by_topic)
        had_commander = False
        while not stop and not (had_commander and listeners.are_connected()):
            loop.wait(BEAT)
            has_commander = count_publishers(self, commands) > own
            if has_commander and not had_commander:
                listeners.expect_more()
            had_commander = has_commander
            listeners.update()

    def _begin(self) -> None:
        """Move the replay to its start, `start_offset` seconds after the first message."""
        self._next = self._schedule.index_at(self._start_ns)
        self._playhead.jump(self._start_ns, time.monotonic())

    def _is_over(self) -> bool:
        if self._next < len(self._schedule.messages):
            return False
        if not self._settings['loop']:
            return True
        if self._playhead.remaining(self._end_ns, time.monotonic()) <= 0.0:
            self._publish_latched()
            self._begin()
        return False

    def _serve(self, loop: EventLoop) -> None:
        """Serve callbacks until a message is due, at most 0.1 s; if paused, resend `/clock`."""
        messages = self._schedule.messages
        due = messages[self._next].time_ns if self._next < len(messages) else self._end_ns
        remaining = self._playhead.remaining(due, time.monotonic())
        loop.wait(max(0.0, min(remaining, BEAT)))
        if math.isinf(remaining) and self._last_clock is not None:
            self._publishers_by_topic[_CLOCK].publish(self._last_clock)

    def _publish_due(self) -> None:
        now, messages = time.monotonic(), self._schedule.messages
        if self._next < len(messages):
            due = messages[self._next].time_ns
            # A burst of messages would overflow the queues of subscribers.
            if self._playhead.remaining(due, now) < -_LONGEST_STALL:
                self._playhead.jump(due, now)
        position = self._playhead.position_ns(now)
        while (
            not self._is_paused
            and self._next < len(messages)
            and messages[self._next].time_ns <= position
        ):
            self._publish(messages[self._next])
            self._next += 1

    def _publish_latched(self) -> None:
        for message in self._schedule.latched_at(self._start_ns):
            self._publish(message)

    def _publish(self, message: ReplayMessage) -> None:
        self._publishers_by_topic[message.name].publish(message.data)
        if message.name == _CLOCK:
            self._last_clock = message.data

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        if request.data == self._is_paused:
            response.message = 'already paused' if request.data else 'already running'
        else:
            response.message = 'paused' if request.data else 'running'
        self._is_paused = request.data
        self._playhead.set_rate(self._rate, time.monotonic())
        response.success = True
        return response

    def _apply_changes(self, changes: list[Any]) -> None:
        for change in changes:
            self._settings[change.name] = change.value
        self._playhead.set_rate(self._rate, time.monotonic())
