"""The loop both nodes run in, with and without rclpy's EventsExecutor."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable

import pytest
from rclpy.clock_type import ClockType
from rclpy.publisher import Publisher
from std_msgs.msg import Float64

from node_runtime.event_loop import EventLoop
from node_runtime.ros import seldom
from support import wait_until


def connected_publisher(node, callback: Callable[[Float64], None]) -> Publisher:
    node.create_subscription(Float64, 'numbers', callback, 10)
    publisher = node.create_publisher(Float64, 'numbers', 10)
    wait_until(publisher.get_subscription_count, 'subscription')
    return publisher


@pytest.mark.parametrize('has_events_executor', [True, False])
def test_messages_are_served_in_order_and_no_more_than_the_limit_at_once(
    node, has_events_executor, monkeypatch
):
    if not has_events_executor:
        monkeypatch.setitem(sys.modules, 'rclpy.experimental.events_executor', None)
    received: list[float] = []
    publisher = connected_publisher(node, lambda message: received.append(message.data))
    loop = EventLoop(node)
    loop.wait(0.1)
    loop.wait(0.1)
    for number in range(8):
        publisher.publish(Float64(data=float(number)))
    time.sleep(0.2)
    loop.serve_pending(5)
    assert len(received) <= 5

    def all_served():
        loop.serve_pending(100)
        loop.wait(0.01)
        return len(received) == 8

    wait_until(all_served, 'rest')
    assert received == [float(number) for number in range(8)]
    loop.close()


def test_wait_ends_in_time_without_anything_to_serve(node):
    loop = EventLoop(node)
    for _ in range(20):
        loop.wait(0.0)
    began = time.monotonic()
    loop.wait(0.1)
    assert 0.05 < time.monotonic() - began < 1.0
    loop.close()


SUSPENDED = """
import rclpy
from std_msgs.msg import Float64
from node_runtime import event_loop
event_loop._SUSPENDED = 1.0
rclpy.init()
node = rclpy.create_node('suspended')
publisher = node.create_publisher(Float64, 'numbers', 10)
loop = event_loop.EventLoop(node)
while True:
    loop.wait(0.1)
"""
SHORT_LEASE = """<?xml version="1.0"?>
<dds xmlns="http://www.eprosima.com"><profiles>
<participant profile_name="short_lease" is_default_profile="true"><rtps><builtin>
<discovery_config>
<leaseDuration><sec>2</sec></leaseDuration>
<leaseAnnouncement><sec>0</sec><nanosec>500000000</nanosec></leaseAnnouncement>
</discovery_config>
</builtin></rtps></participant>
</profiles></dds>
"""


def test_a_node_keeps_its_name_after_a_suspension(node, start_process, tmp_path, monkeypatch):
    """Other participants forget it after its lease, 20 s by default."""
    profile = tmp_path / 'profile.xml'
    profile.write_text(SHORT_LEASE)
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(profile))
    process = start_process(sys.executable, '-c', SUSPENDED)

    def wait_for_names(expected):
        publishers = node.get_publishers_info_by_topic
        wait_until(lambda: [p.node_name for p in publishers('/numbers')] == expected, expected)

    wait_for_names(['suspended'])
    process.send_signal(signal.SIGSTOP)
    wait_for_names([])
    process.send_signal(signal.SIGCONT)
    wait_for_names(['suspended'])
    process.kill()


def test_an_error_in_a_callback_is_not_swallowed(node):
    def fail(message):
        raise RuntimeError('from the callback')

    loop = EventLoop(node)
    connected_publisher(node, fail).publish(Float64())
    with pytest.raises(RuntimeError, match='from the callback'):
        wait_until(lambda: loop.wait(0.05), 'error')
    loop.close()


def test_a_line_is_throttled_by_the_steady_clock(node):
    assert seldom(0.5)['throttle_time_source_type'].clock_type is ClockType.STEADY_TIME
    said = []
    for pause in (0.0, 0.0, 0.6):
        time.sleep(pause)
        said.append(node.get_logger().warning('line', **seldom(0.5)))
    assert said == [True, False, True]
