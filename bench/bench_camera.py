"""Measure the CPU time of `visualization_node`'s camera, with and without subscribers.

`make bench-camera` runs it, beside a robot in real time: without a subscriber, with one of raw
pictures, with one of JPEG. It prints the CPU time of `visualization_node`, the pictures that
arrived, and the rate of `joint_states`.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import rclpy
from bench_rate import Watcher

from fetch_hand_sim.commands.node_processes import start_node, stop_node
from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.topics import topic, view_topics
from node_runtime.event_loop import EventLoop
from node_runtime.ros import keep_discovery_local, subscribe

_TICKS_PER_SECOND = os.sysconf('SC_CLK_TCK')
# Seconds before each measurement.
_SETTLING = 4.0
_END_TIMEOUT = 60.0


def processor_seconds(pid: int) -> float:
    """Returns what a process has used of processors, in all its threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    user, system = int(fields[11]), int(fields[12])
    return (user + system) / _TICKS_PER_SECOND


def look(task: str, name: str, seconds: float) -> None:
    """Takes pictures for a while, as a tool would, and prints how many came."""
    keep_discovery_local()
    rclpy.init()
    node, sizes = rclpy.create_node('looking'), list[int]()
    source = {each.name: each for each in view_topics(task_spec(task))}[name]
    subscribe(node, source, lambda data: sizes.append(len(data)), raw=True)
    loop = EventLoop(node)
    for duration in (_SETTLING, seconds):
        sizes.clear()
        end = time.monotonic() + duration
        while (left := end - time.monotonic()) > 0.0:
            loop.wait(left)
    size = sum(sizes) / max(1, len(sizes)) / 1e3
    print(f'  {len(sizes) / seconds:.1f} pictures/s of {size:.0f} kB', flush=True)
    loop.close()
    node.destroy_node()
    rclpy.shutdown()


def measure(watcher: Watcher, pid: int, label: str, seconds: float) -> None:
    """Prints the figures of one measurement."""
    watcher.start(_SETTLING)
    used = processor_seconds(pid)
    watcher.watch(seconds)
    share = 100.0 * (processor_seconds(pid) - used) / seconds
    print(f'{label}: visualization_node takes {share:.1f} % of a processor', flush=True)
    watcher.report('  joint_states')


def main() -> None:
    """Measure without subscriber, with raw pictures, with JPEG."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--seconds', type=float, default=20.0, help='per measurement')
    parser.add_argument('--hz', type=float, default=10.0, help='pictures per second')
    parser.add_argument('--size', default='640x480', help='of the pictures')
    parser.add_argument('--look', default='', help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.look:
        look(options.task, options.look, options.seconds)
        return
    width, _, height = options.size.partition('x')
    keep_discovery_local()
    rclpy.init()
    print(f'{options.task}, {options.size} at {options.hz:g} Hz, {os.cpu_count()} CPUs', flush=True)
    with ExitStack() as stack:
        watcher = Watcher(topic(task_spec(options.task), 'joint_states'))
        sim = start_node('sim_node', {'task': options.task}, sys.stderr)
        stack.callback(stop_node, sim)
        camera = {
            'camera_hz': options.hz,
            'camera_width': int(width),
            'camera_height': int(height),
        }
        node = start_node('visualization_node', camera, sys.stderr)
        stack.callback(stop_node, node)
        watcher.wait_for_ticks()
        measure(watcher, node.pid, 'no subscriber', options.seconds)
        for name, label in (
            ('camera/image_raw', 'raw pictures'),
            ('camera/image_raw/compressed', 'JPEG'),
        ):
            words = ['--task', options.task, '--seconds', str(options.seconds), '--look', name]
            viewer = subprocess.Popen([sys.executable, __file__, *words])
            measure(watcher, node.pid, label, options.seconds)
            viewer.wait(_END_TIMEOUT)
        measure(watcher, node.pid, 'no subscriber any more', options.seconds)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
