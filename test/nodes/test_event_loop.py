"""The loop both nodes run in, with and without rclpy's EventsExecutor."""

from __future__ import annotations

import signal
import sys
import time
from collections.abc import Callable

import pytest
from std_msgs.msg import Float64

from node_runtime.event_loop import EventLoop


def collect(node) -> tuple[list[float], object]:
    received: list[float] = []
    node.create_subscription(Float64, 'numbers', lambda m: received.append(m.data), 10)
    publisher = node.create_publisher(Float64, 'numbers', 10)
    deadline = time.monotonic() + 10.0
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    return received, publisher


def serve_until(loop: EventLoop, condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        loop.serve_pending(100)
        loop.wait(0.01)


def test_no_more_than_the_limit_is_served_at_once(node):
    received, publisher = collect(node)
    loop = EventLoop(node)
    loop.wait(0.1)
    loop.wait(0.1)
    for number in range(8):
        publisher.publish(Float64(data=float(number)))
    time.sleep(0.2)
    loop.serve_pending(5)
    assert len(received) <= 5
    serve_until(loop, lambda: len(received) == 8)
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


def test_older_rclpy_without_events_executor(node, monkeypatch):
    monkeypatch.setitem(sys.modules, 'rclpy.experimental.events_executor', None)
    received, publisher = collect(node)
    loop = EventLoop(node)
    publisher.publish(Float64(data=7.0))
    serve_until(loop, lambda: len(received) == 1)
    for number in range(5):
        publisher.publish(Float64(data=float(number)))
    serve_until(loop, lambda: len(received) == 6)
    assert received == [7.0, 0.0, 1.0, 2.0, 3.0, 4.0]
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
        deadline, names = time.monotonic() + 20.0, None
        while names != expected:
            assert time.monotonic() < deadline, names
            time.sleep(0.1)
            names = [each.node_name for each in node.get_publishers_info_by_topic('/numbers')]

    wait_for_names(['suspended'])
    process.send_signal(signal.SIGSTOP)
    wait_for_names([])
    process.send_signal(signal.SIGCONT)
    wait_for_names(['suspended'])
    process.kill()


def test_an_error_in_a_callback_is_not_swallowed(node):
    loop = EventLoop(node)
    publisher = node.create_publisher(Float64, 'numbers', 10)

    def fail(message):
        raise RuntimeError('from the callback')

    node.create_subscription(Float64, 'numbers', fail, 10)
    deadline = time.monotonic() + 10.0
    while not publisher.get_subscription_count():
        assert time.monotonic() < deadline
        time.sleep(0.01)
    publisher.publish(Float64())
    with pytest.raises(RuntimeError, match='from the callback'):
        while time.monotonic() < deadline:
            loop.wait(0.05)
    loop.close()
