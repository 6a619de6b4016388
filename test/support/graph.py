"""A plain rclpy client of a robot, as any other program on the network would write it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticStatus
from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from std_msgs.msg import Float64MultiArray

from fetch_hand_sim.episode_log import Episode, read_episode
from msgs_spec.codecs import decode_status, message_stamp
from msgs_spec.tasks import TaskSpec
from msgs_spec.tick import EpisodeStatus
from msgs_spec.topics import MONITORING, TopicSpec, topic, topics, view_topics
from node_runtime.ros import open_publisher, subscribe

SIM_NODE = (sys.executable, '-m', 'fetch_hand_sim.sim_node')
POLICY_NODE = (sys.executable, '-m', 'policy_node.node')
VIEW = (sys.executable, '-m', 'fetch_hand_sim.view', '--no-browser')
TIMEOUT = 30.0
Start = Callable[..., subprocess.Popen[str]]


def ros_args(**parameters: object) -> list[str]:
    """Command line of a node with these parameters."""
    words = ['--ros-args']
    for name, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else str(value)
        words += ['-p', f'{name}:={text}']
    return words


def finish(process: subprocess.Popen[str], timeout: float = TIMEOUT) -> tuple[int, str]:
    """Waits for a process; returns its exit code and all it printed."""
    output, errors = process.communicate(timeout=timeout)
    return process.returncode, (output or '') + (errors or '')


def end(process: subprocess.Popen[str]) -> str:
    """Ends a node as Ctrl-C does; returns what it printed."""
    process.send_signal(signal.SIGINT)
    code, output = finish(process)
    assert code == 0, output
    assert 'Traceback' not in output
    return output


def episodes_in(directory: Path) -> list[Episode]:
    """The finished episodes of a directory, in order."""
    return [read_episode(path) for path in sorted(directory.iterdir()) if path.name[0] != '.']


def logged_run(
    start: Start, directory: Path, *words: object, **parameters: object
) -> list[Episode]:
    """Run a robot that waits for commands, in lockstep by default; return its episodes."""
    settings = {'mode': 'lockstep', 'wait_for_commands': True, 'episode_dir': directory}
    robot = start(*SIM_NODE, *ros_args(**settings | parameters), *words)
    code, output = finish(robot, timeout=120.0)
    assert code == 0, output
    return episodes_in(directory)


def open_view(start: Start, *arguments: object) -> tuple[subprocess.Popen[str], str, list[str]]:
    """Start a page; return its process, its address and its output up to the address."""
    view = start(*VIEW, *arguments)
    said = []
    while not said or 'The page is at' not in said[-1]:
        said.append(view.stdout.readline())
        assert said[-1], finish(view)
    return view, re.findall(r'http://\S+', said[-1])[0], said


def payload(episode: Episode) -> dict[str, list[tuple[int, int, bytes]]]:
    """Everything the messages of an episode consist of."""
    return {
        name: [(m.log_time_ns, m.sequence, m.data) for m in logged.messages]
        for name, logged in episode.topics.items()
    }


class Client:
    """Receives every topic of a robot and sends commands."""

    def __init__(self, spec: TaskSpec, name: str = 'client', namespace: str = '') -> None:
        self.spec = spec
        self.node = rclpy.create_node(name, namespace=namespace)
        self.received: dict[str, list[Any]] = defaultdict(list)
        self.received_at: dict[str, list[float]] = defaultdict(list)
        self._executor = SingleThreadedExecutor()
        self._executor.add_node(self.node)
        self._publishers: dict[str, Any] = {}
        self._service_clients: dict[str, Any] = {}

    def subscribe(self, *names: str, depth: int | None = None) -> None:
        """Subscribes to topics, or to all; keeps `depth` messages until served."""
        for name in names or [s.name for s in topics(self.spec) if s.direction == 'published']:
            source = self._topic(name)
            qos = replace(source.qos, depth=depth or source.qos.depth)
            subscribe(self.node, source, self._collector(name), qos=qos)

    def publish(self, name: str, message: Any) -> None:
        self.publisher(name).publish(message)

    def publisher(self, name: str) -> Any:
        if name not in self._publishers:
            self._publishers[name] = open_publisher(self.node, topic(self.spec, name))
        return self._publishers[name]

    def command(self, *values: float) -> None:
        self.publish('commands', Float64MultiArray(data=[float(value) for value in values]))

    def connect(self, name: str) -> None:
        """Waits until the robot listens to a topic."""
        publisher = self.publisher(name)
        self.spin_until(lambda: publisher.get_subscription_count() > 0, f'a listener on {name}')

    def spin(self, seconds: float) -> None:
        end = time.monotonic() + seconds
        while (left := end - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    def spin_until(
        self, condition: Callable[[], bool], what: str, timeout: float = TIMEOUT
    ) -> None:
        """Spin until a condition holds; it may use messages that have not come yet."""
        end = time.monotonic() + timeout

        def holds() -> bool:
            try:
                return bool(condition())
            except LookupError:
                return False

        while not holds():
            assert time.monotonic() < end, f'no {what} within {timeout} s'
            self._executor.spin_once(timeout_sec=0.05)

    def call(self, type_: Any, name: str, **fields: Any) -> Any:
        if name not in self._service_clients:
            self._service_clients[name] = self.node.create_client(type_, name)
        client = self._service_clients[name]
        self.spin_until(client.service_is_ready, f'service {name}')
        future = client.call_async(type_.Request(**fields))
        self.spin_until(future.done, f'answer of {name}')
        return future.result()

    def set_parameter(self, node: str, name: str, value: object) -> SetParametersResult:
        parameter = Parameter(name, value=value).to_parameter_msg()
        answer = self.call(SetParameters, f'{node}/set_parameters', parameters=[parameter])
        (result,) = answer.results
        return result

    def stamps(self, name: str) -> list[int]:
        """The stamps received on a topic, each once: a robot that stands still repeats itself."""
        parts = (getattr(m, 'markers', getattr(m, 'transforms', [m])) for m in self.received[name])
        return list(dict.fromkeys(message_stamp(part[0]) for part in parts))

    def statuses(self) -> list[EpisodeStatus]:
        messages = self.received['episode_status']
        return [EpisodeStatus.from_values(decode_status(message)) for message in messages]

    def reports(self, node: str = '/sim_node') -> list[DiagnosticStatus]:
        """Return the reports of a node on `/diagnostics`."""
        found = (message.status[0] for message in self.received['/diagnostics'])
        return [status for status in found if status.name == node]

    def values(self, node: str = '/sim_node') -> dict[str, str]:
        """The facts of its last report."""
        return {pair.key: pair.value for pair in self.reports(node)[-1].values}

    def close(self) -> None:
        self._executor.remove_node(self.node)
        self.node.destroy_node()

    def _topic(self, name: str) -> TopicSpec:
        others = {spec.name: spec for spec in (*MONITORING, *view_topics(self.spec))}
        return others.get(name) or topic(self.spec, name)

    def _collector(self, name: str) -> Callable[[Any], None]:
        def collect(message: Any) -> None:
            self.received_at[name].append(time.monotonic())
            self.received[name].append(message)

        return collect


@contextmanager
def client(spec: TaskSpec, name: str = 'client', namespace: str = '') -> Iterator[Client]:
    """A client on the private graph of this test run."""
    rclpy.init()
    connection = Client(spec, name, namespace)
    try:
        yield connection
    finally:
        connection.close()
        rclpy.shutdown()
