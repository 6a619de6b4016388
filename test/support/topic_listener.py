"""Subscribes to the published topics of a task, typed and raw; prints what arrives as JSON lines.

Run as `python topic_listener.py <task> <messages>`; ends after that many messages or 30 seconds.
"""

from __future__ import annotations

import json
import sys
import time

import rclpy
from rclpy.executors import SingleThreadedExecutor

from msgs_spec.codecs import decode, decode_status, message_stamp
from msgs_spec.tasks import TASKS
from msgs_spec.topics import topics
from node_runtime.ros import rclpy_profile, ros_message_class

DEADLINE = 30.0


def describe(spec, message):
    """Return the content of a typed message as JSON."""
    said = {'topic': spec.name, 'kind': 'typed'}
    if hasattr(message, 'header') or hasattr(message, 'clock'):
        said['stamp'] = message_stamp(message)
    if spec.name == 'episode_status':
        return said | {'values': decode_status(message)}
    return said | {'vector': decode(spec, message).tobytes().hex()}


def main():
    task, count = TASKS[sys.argv[1]], int(sys.argv[2])
    received = 0

    def report(said):
        nonlocal received
        received += 1
        print(json.dumps(said), flush=True)

    rclpy.init()
    node = rclpy.create_node('topic_listener')
    for spec in topics(task):
        if spec.direction != 'published':
            continue
        message_class, profile = ros_message_class(spec.type_name), rclpy_profile(spec.qos)
        node.create_subscription(
            message_class,
            spec.name,
            lambda message, spec=spec: report(describe(spec, message)),
            profile,
        )
        node.create_subscription(
            message_class,
            spec.name,
            lambda data, spec=spec: report({'topic': spec.name, 'kind': 'raw', 'data': data.hex()}),
            profile,
            raw=True,
        )
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    end = time.monotonic() + DEADLINE
    while received < count and time.monotonic() < end:
        executor.spin_once(timeout_sec=0.1)
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
