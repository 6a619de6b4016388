"""Sends messages of 10 MB as commands, ten a second, until it is ended, for `bench_rate.py`."""

from __future__ import annotations

import sys
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

import rclpy  # noqa: E402

from msgs_spec.codecs import TopicCodec  # noqa: E402
from msgs_spec.tasks import task_spec  # noqa: E402
from msgs_spec.topics import topic  # noqa: E402
from node_runtime.ros import (  # noqa: E402
    keep_discovery_local,
    leave_out_shared_memory,
    open_publisher,
)

BYTES = 10_000_000


def main() -> None:
    """Publishes for ever."""
    keep_discovery_local()
    leave_out_shared_memory()
    rclpy.init()
    commands = topic(task_spec('FetchReach'), 'commands')
    large = TopicCodec(commands).encode(0, [0.0] * 4) + bytes(BYTES)
    node = rclpy.create_node('large_messages')
    publisher = open_publisher(node, commands)
    while True:
        publisher.publish(large)
        time.sleep(0.1)


if __name__ == '__main__':
    main()
