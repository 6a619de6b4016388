"""Lockstep ticks per second of two processes, beside the limit of the middleware.

`make bench-lockstep` starts `sim_node` and `policy_node` in lockstep and reads their tick counter
from `/diagnostics`. In turns with them it runs a bare ping-pong in two processes: one steps MuJoCo
20 times and publishes the bytes of the same topics, the other answers the last of them with the
bytes of a command. Both use raw messages and rclpy's EventsExecutor, so nothing in rclpy is faster.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import time
from typing import Any

import mujoco
import numpy as np
import rclpy

from fetch_hand_sim.commands.node_processes import start_nodes, stop_node
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.codecs import TopicCodec, decode_status
from msgs_spec.observations import ObservationAssembler
from msgs_spec.tasks import TASKS, TaskSpec, task_spec
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import DIAGNOSTICS, STATE, topic, topics
from node_runtime.event_loop import EventLoop
from node_runtime.ros import (
    keep_discovery_local,
    leave_out_shared_memory,
    open_publisher,
    subscribe,
)

# A graph of its own; below 102, where the ports of DDS meet those of Linux.
os.environ.setdefault('ROS_DOMAIN_ID', str(40 + os.getpid() % 62))

SUBSTEPS = 20
TIMEOUT = 60.0


def observed(spec: TaskSpec) -> list[str]:
    """The topics a policy needs, in the order they are published."""
    names = {source.name for source in ObservationAssembler(spec, 25.0).topics}
    return [source.name for source in topics(spec) if source.name in names]


def echo(spec: TaskSpec) -> None:
    """The other half of the ping-pong: answers the last topic of each tick; runs until killed."""
    rclpy.init()
    node = rclpy.create_node('echo')
    commands = topic(spec, 'commands')
    publisher = open_publisher(node, commands)
    command = TopicCodec(commands).encode(0, np.zeros(commands.size))
    *others, last = observed(spec)
    for name in others:
        subscribe(node, topic(spec, name), lambda data: None, qos=STATE, raw=True)
    subscribe(node, topic(spec, last), lambda data: publisher.publish(command), qos=STATE, raw=True)
    loop = EventLoop(node)
    while True:
        loop.wait(1.0)


def wait_until(loop: EventLoop, condition: Any, what: str, timeout: float = TIMEOUT) -> None:
    """Serves callbacks until a condition holds."""
    end = time.monotonic() + timeout
    while not condition():
        if time.monotonic() > end:
            raise SystemExit(f'bench_lockstep: no {what} within {timeout:g} s')
        loop.wait(0.05)


class Limit:
    """The ping-pong: ticks per second of `mj_step` and messages alone."""

    def __init__(self, spec: TaskSpec) -> None:
        simulation = Simulation(spec.name, num_threads=1)
        runner = EpisodeRunner(simulation)
        runner.advance(runner.resting_command())
        self._spec = spec
        self._messages = TickEncoder(spec).encode(runner.advance(runner.resting_command()))
        self._model, self._data = simulation.model, mujoco.MjData(simulation.model)
        mujoco.mj_step(self._model, self._data, 500)

    def measure(self, seconds: float) -> float:
        """Ticks per second of one run."""
        node = rclpy.create_node('ping')
        loop = EventLoop(node)
        answers = [0]

        def on_command(data: bytes) -> None:
            answers[0] += 1

        subscribe(node, topic(self._spec, 'commands'), on_command, raw=True)
        publishers = {source.name: open_publisher(node, source) for source, _ in self._messages}
        other = subprocess.Popen([sys.executable, __file__, '--task', self._spec.name, '--echo'])
        try:
            needed = [publishers[name] for name in observed(self._spec)]
            wait_until(loop, lambda: all(p.get_subscription_count() for p in needed), 'echo')
            wait_until(loop, lambda: node.count_publishers('commands') > 0, 'echo')
            time.sleep(0.5)
            return self._ping(loop, publishers, answers, seconds)
        finally:
            other.kill()
            other.wait()
            loop.close()
            node.destroy_node()

    def _ping(
        self, loop: EventLoop, publishers: dict[str, Any], answers: list[int], seconds: float
    ) -> float:
        began, ticks = time.perf_counter(), 0
        while (elapsed := time.perf_counter() - began) < seconds:
            mujoco.mj_step(self._model, self._data, SUBSTEPS)
            for source, data in self._messages:
                publishers[source.name].publish(data)
            ticks += 1
            while answers[0] < ticks:
                loop.wait(1.0)
        return ticks / elapsed


def measure_nodes(spec: TaskSpec, policy: str, seconds: float) -> float:
    """Ticks per second of the two nodes, from the tick counter they publish."""
    node = rclpy.create_node('watcher')
    loop = EventLoop(node)
    counts: list[tuple[float, int]] = []

    def on_report(message: Any) -> None:
        values = decode_status(message)
        if 'ticks' in values:
            counts.append((time.perf_counter(), int(values['ticks'])))

    subscribe(node, DIAGNOSTICS, on_report)
    sim = {'task': spec.name, 'mode': 'lockstep', 'wait_for_commands': True}
    processes = start_nodes({'sim_node': sim, 'policy_node': {'policy': policy}}, sys.stderr)
    try:
        wait_until(loop, lambda: counts and counts[-1][1] > 100, 'ticks')
        counts.clear()

        def is_measured() -> bool:
            return bool(counts) and counts[-1][0] - counts[0][0] >= seconds

        wait_until(loop, is_measured, 'tick counter', TIMEOUT + seconds)
    finally:
        for process in processes:
            stop_node(process)
        loop.close()
        node.destroy_node()
    (began, first), (ended, last) = counts[0], counts[-1]
    return (last - first) / (ended - began)


def main() -> int:
    """Measures in turns and prints the medians."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--policy', default='', help="actor, 'random'; default: the shipped")
    parser.add_argument('--seconds', type=float, default=5.0, help='per measurement')
    parser.add_argument('--turns', type=int, default=3)
    parser.add_argument('--echo', action='store_true', help=argparse.SUPPRESS)
    options = parser.parse_args()
    spec = task_spec(options.task)
    keep_discovery_local()
    leave_out_shared_memory()
    if options.echo:
        echo(spec)
    rclpy.init()
    load = os.getloadavg()[0]
    limit = Limit(spec)
    nodes, limits = [], []
    for _ in range(options.turns):
        limits.append(limit.measure(options.seconds))
        nodes.append(measure_nodes(spec, options.policy, options.seconds))
        print(f'nodes {nodes[-1]:.0f}, limit {limits[-1]:.0f} ticks per second', flush=True)
    rclpy.shutdown()
    ours, bare = statistics.median(nodes), statistics.median(limits)
    print(
        f'{spec.name}, {options.policy or "shipped actor"}: {ours:.0f} ticks per second, '
        f'{ours / 25.0:.1f} x real time, {ours / bare:.0%} of the limit {bare:.0f} '
        f'(goals: 12 x, 70 %); {platform.machine()}, {os.cpu_count()} CPUs, '
        f'load average {load:.1f} before'
    )
    return 0


if __name__ == '__main__':
    sys.exit(main())
