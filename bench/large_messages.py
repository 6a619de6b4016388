"""Sends messages of 10 MB as commands, ten a second, until it is ended, for `bench_rate.py`."""

from __future__ import annotations

import time

import rclpy

from msgs_spec.codecs import TopicCodec
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic
from node_runtime.ros import keep_discovery_local, leave_out_shared_memory, open_publisher

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
