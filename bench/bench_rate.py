"""Measure the rate of `joint_states` in real time with an independent subscriber.

`make bench-rate` runs it: on the idle machine, beside ten messages of 10 MB a second, then with a
busy process on every CPU. Late ticks are those `sim_node`
counts itself, read from `/diagnostics`. At the end: how soon after its start a policy commands.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import rclpy

from fetch_hand_sim.commands.node_processes import start_node, stop_node
from msgs_spec.codecs import decode_status
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.topics import DIAGNOSTICS, TopicSpec, topic
from node_runtime.diagnostics import MISSED_TICKS
from node_runtime.event_loop import EventLoop
from node_runtime.ros import keep_discovery_local, leave_out_shared_memory, subscribe

ROOT = Path(__file__).resolve().parents[1]
# A graph of its own; below 102, where the ports of DDS meet those of Linux.
os.environ.setdefault('ROS_DOMAIN_ID', str(40 + os.getpid() % 62))


class Watcher:
    """Records the arrival of joint states and the missed ticks that the robot reports."""

    def __init__(self, joint_states: TopicSpec) -> None:
        self.times: list[float] = []
        self._missed = self._missed_before = 0
        self.node = rclpy.create_node('watcher')
        subscribe(self.node, joint_states, self._on_state, raw=True)
        subscribe(self.node, DIAGNOSTICS, self._on_report)
        self._loop = EventLoop(self.node)

    def watch(self, seconds: float) -> None:
        """Serves callbacks for this long."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0.0:
            self._loop.wait(min(left, 0.1))

    def wait_for_ticks(self, timeout: float = 60.0) -> None:
        """Wait for the first ticks of the robot."""
        end = time.perf_counter() + timeout
        while len(self.times) < 25:
            if time.perf_counter() > end:
                raise SystemExit(f'bench_rate: no joint_states within {timeout:g} s')
            self._loop.wait(0.1)

    def start(self, settling: float) -> None:
        """Serves callbacks for `settling` seconds, then starts a measurement."""
        self.watch(settling)
        self.times.clear()
        self._missed_before = self._missed

    def report(self, label: str, factor: float = 1.0) -> None:
        """Prints the periods and missed ticks since `start`; `factor` is the real-time factor."""
        periods = 1e3 * np.diff(self.times)
        wanted = 40.0 / factor
        late = np.abs(periods - wanted)
        low, high = np.percentile(periods, (1, 99))
        print(
            f'{label}: {len(periods)} periods, {1e3 / periods.mean():.3f} Hz, std '
            f'{periods.std():.3f} ms, p1 {low:.3f}, p99 {high:.3f} ms, '
            f'|period - {wanted:g} ms| median {np.median(late):.3f}, p99 '
            f'{np.percentile(late, 99):.3f}, max {late.max():.3f} ms; '
            f'{self._missed - self._missed_before} ticks missed; '
            f'load average {os.getloadavg()[0]:.1f}',
            flush=True,
        )

    def _on_state(self, data: bytes) -> None:
        self.times.append(time.perf_counter())

    def _on_report(self, message: Any) -> None:
        self._missed = int(decode_status(message).get(MISSED_TICKS, self._missed))


@contextmanager
def running(programs: list[list[str]]) -> Iterator[None]:
    """Runs Python with these arguments, one process each, until the block ends."""
    others = [subprocess.Popen([sys.executable, *program], cwd=ROOT) for program in programs]
    try:
        yield
    finally:
        for process in others:
            process.kill()
            process.wait()


def first_command(watcher: Watcher, task: str, commands: list[float]) -> float:
    """Starts a policy; returns the seconds until `commands` gets the arrival of its first one."""
    # The previous policy has sent more commands than the first, which are still queued.
    watcher.watch(1.0)
    commands.clear()
    started = time.perf_counter()
    policy = start_node('policy_node', {'task': task}, sys.stderr)
    try:
        while not commands:
            watcher.watch(0.01)
            if policy.poll() is not None:
                raise SystemExit('bench_rate: the policy ended')
        return commands[0] - started
    finally:
        stop_node(policy)


def main() -> int:
    """Measures and prints."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--seconds', type=float, default=60.0, help='per measurement')
    parser.add_argument('--real-time-factor', type=float, default=1.0)
    parser.add_argument('--busy', type=int, default=os.cpu_count(), help='busy processes; 0: none')
    options = parser.parse_args()
    keep_discovery_local()
    leave_out_shared_memory()
    rclpy.init()
    spec = task_spec(options.task)
    watcher = Watcher(topic(spec, 'joint_states'))
    parameters = {'task': options.task, 'real_time_factor': options.real_time_factor}
    sim = start_node('sim_node', parameters, sys.stderr)
    print(f'{options.task} on {platform.machine()}, {os.cpu_count()} CPUs')
    spin, send = ['-c', 'while True: pass'], ['bench/large_messages.py']
    phases: list[tuple[str, list[list[str]]]] = [
        ('machine as it is', []),
        ('10 messages of 10 MB a second', [send]),
        (f'{options.busy} busy processes', [spin] * options.busy),
    ]
    try:
        watcher.wait_for_ticks()
        for label, programs in phases if options.busy else phases[:2]:
            with running(programs):
                watcher.start(4.0)
                watcher.watch(options.seconds)
                watcher.report(label, options.real_time_factor)
        commands: list[float] = []
        subscribe(
            watcher.node,
            topic(spec, 'commands'),
            lambda data: commands.append(time.perf_counter()),
            raw=True,
        )
        for _ in range(5):
            seconds = first_command(watcher, options.task, commands)
            print(f'first command {seconds:.2f} s after the start of a policy', flush=True)
    finally:
        code = stop_node(sim)
    rclpy.shutdown()
    return code


if __name__ == '__main__':
    sys.exit(main())
