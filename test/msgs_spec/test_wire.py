"""A tick on a real ROS graph: what another process gets when its bytes are published."""

from __future__ import annotations

import json
import math
import sys
import time

import pytest

from msgs_spec.schemas import deserialize, serialize
from msgs_spec.tasks import TASKS
from msgs_spec.tick import TickEncoder
from node_runtime.ros import rclpy_profile, ros_message_class
from support import SUPPORT, script_environment
from support.random_ticks import STAMP, random_tick

rclpy = pytest.importorskip('rclpy')
LISTENER = SUPPORT / 'topic_listener.py'


@pytest.fixture
def node():
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node('tick_publisher', context=context)
    yield node
    node.destroy_node()
    rclpy.try_shutdown(context=context)


def wait_for(predicate, what, seconds=20.0):
    end = time.monotonic() + seconds
    while not predicate():
        assert time.monotonic() < end, f'no {what} within {seconds} s'
        time.sleep(0.01)


def read_reports(listener, count):
    """The next reports by topic and kind."""
    reports = {}
    for _ in range(count):
        line = listener.stdout.readline()
        assert line, f'the listener ended: {listener.stderr.read()}'
        report = json.loads(line)
        reports[report['topic'], report['kind']] = report
    return reports


def rclpy_message(spec, data):
    from rclpy.serialization import deserialize_message

    return deserialize_message(data, ros_message_class(spec.type_name))


@pytest.mark.parametrize('name', ['FetchPush', 'HandReach', 'HandManipulateBlockFull'])
def test_published_bytes_are_what_rclpy_would_send(name, node, start_process, ros_environment):
    task = TASKS[name]
    messages = TickEncoder(task).encode(random_tick(task), latched=True)
    listener = start_process(
        sys.executable,
        LISTENER,
        name,
        4 * len(messages),
        env=script_environment(ros_environment),
    )
    publishers = {
        spec: node.create_publisher(
            ros_message_class(spec.type_name), spec.name, rclpy_profile(spec.qos)
        )
        for spec, _ in messages
    }
    wait_for(
        lambda: all(p.get_subscription_count() == 2 for p in publishers.values()), 'subscriber'
    )
    for spec, data in messages:
        publishers[spec].publish(data)
    from_bytes = read_reports(listener, 2 * len(messages))
    for spec, data in messages:
        publishers[spec].publish(rclpy_message(spec, data))
    from_objects = read_reports(listener, 2 * len(messages))
    for spec, data in messages:
        typed = from_bytes[spec.name, 'typed']
        assert typed.get('stamp', STAMP) == STAMP
        assert typed == from_objects[spec.name, 'typed']
        ours, theirs = (
            bytes.fromhex(reports[spec.name, 'raw']['data'])
            for reports in (from_bytes, from_objects)
        )
        # DDS fills the last four bytes up.
        assert len(ours) == len(theirs) == 4 * math.ceil(len(data) / 4)
        assert ours.startswith(data)
        # rclpy leaves the padding between fields unset, on the wire too.
        assert serialize(spec.type_name, deserialize(spec.type_name, theirs)) == data
    assert listener.wait(timeout=20) == 0
