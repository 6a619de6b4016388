"""What the camera of `visualization_node` costs, with and without somebody who looks.

`make bench-camera` runs it. A robot runs in real time, `visualization_node` beside it; in turn
nobody subscribes, then somebody takes raw pictures, then JPEG. Said is the processor time of
`visualization_node`, what arrived of pictures, and the rate of `joint_states`.
"""

from __future__ import annotations

import argparse
import os
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / 'bench')]

import rclpy  # noqa: E402
from bench_rate import Watcher, report  # noqa: E402
from bench_view import start  # noqa: E402

from msgs_spec.ros import (  # noqa: E402
    EventLoop,
    keep_discovery_local,
    rclpy_profile,
    ros_message_class,
)
from msgs_spec.tasks import TASKS, task_spec  # noqa: E402
from msgs_spec.topics import topic  # noqa: E402
from msgs_spec.view_topics import view_topic  # noqa: E402

_TICKS_PER_SECOND = os.sysconf('SC_CLK_TCK')


def processor_seconds(pid: int) -> float:
    """Returns what a process has used of processors, in all its threads."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    user, system = int(fields[11]), int(fields[12])
    return (user + system) / _TICKS_PER_SECOND


class Viewer:
    """Takes pictures, as a tool would, in a node of its own."""

    def __init__(self, task: str, name: str) -> None:
        """Subscribes."""
        self.count = self.bytes = 0
        self._node = rclpy.create_node('looking')
        source = view_topic(task_spec(task), name)
        self._node.create_subscription(
            ros_message_class(source.type_name),
            source.name,
            self._take,
            rclpy_profile(source.qos),
            raw=True,
        )
        self._loop = EventLoop(self._node)

    def _take(self, data: bytes) -> None:
        self.count, self.bytes = self.count + 1, self.bytes + len(data)

    def serve(self) -> None:
        """Takes what is there."""
        self._loop.serve_pending(10)

    def close(self) -> None:
        """Leaves."""
        self._loop.close()
        self._node.destroy_node()


def watch(watcher: Watcher, viewer: Viewer | None, seconds: float) -> None:
    """Watches the robot and takes pictures for a while."""
    for _ in range(round(seconds / 0.1)):
        watcher.watch(0.1)
        if viewer is not None:
            viewer.serve()


def measure(watcher: Watcher, pid: int, viewer: Viewer | None, label: str, seconds: float) -> None:
    """Prints the figures of one measurement."""
    watch(watcher, viewer, 3.0)
    watcher.times.clear()
    missed, used = watcher.missed, processor_seconds(pid)
    before = (viewer.count, viewer.bytes) if viewer else (0, 0)
    watch(watcher, viewer, seconds)
    share = 100.0 * (processor_seconds(pid) - used) / seconds
    line = f'{label}: visualization_node takes {share:.1f} % of a processor'
    if viewer is not None:
        count, size = viewer.count - before[0], viewer.bytes - before[1]
        line += f', {count / seconds:.1f} pictures/s of {size / max(1, count) / 1e3:.0f} kB'
    print(line, flush=True)
    report('  joint_states', watcher.times, watcher.missed - missed, 1.0)


def main() -> None:
    """Measures without anybody, with raw pictures, with JPEG."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', default='FetchPush', choices=tuple(TASKS))
    parser.add_argument('--seconds', type=float, default=20.0, help='per measurement')
    parser.add_argument('--hz', type=float, default=10.0, help='pictures per second')
    parser.add_argument('--size', default='640x480', help='of the pictures')
    options = parser.parse_args()
    width, _, height = options.size.partition('x')
    keep_discovery_local()
    rclpy.init()
    print(f'{options.task}, {options.size} at {options.hz:g} Hz, {os.cpu_count()} CPUs', flush=True)
    with ExitStack() as stack:
        watcher = Watcher(topic(task_spec(options.task), 'joint_states'))
        start(stack, 'fetch_hand_sim.sim_node', '--ros-args', '-p', f'task:={options.task}')
        settings: dict[str, Any] = {
            'camera_hz': float(options.hz),
            'camera_width': int(width),
            'camera_height': int(height),
        }
        words = [word for item in settings.items() for word in ('-p', ':='.join(map(str, item)))]
        node = start(stack, 'fetch_hand_sim.visualization_node', '--ros-args', *words)
        watcher.wait_for_ticks()
        measure(watcher, node.pid, None, 'nobody looks', options.seconds)
        for name, label in (
            ('camera/image_raw', 'raw pictures'),
            ('camera/image_raw/compressed', 'JPEG'),
        ):
            viewer = Viewer(options.task, name)
            measure(watcher, node.pid, viewer, label, options.seconds)
            viewer.close()
        measure(watcher, node.pid, None, 'nobody any more', options.seconds)
    rclpy.shutdown()


if __name__ == '__main__':
    main()
