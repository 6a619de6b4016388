"""Throttled log lines."""

from __future__ import annotations

import time

from rclpy.clock_type import ClockType

from node_runtime.ros import seldom


def test_a_line_is_throttled_by_the_steady_clock(node):
    assert seldom(0.5)['throttle_time_source_type'].clock_type is ClockType.STEADY_TIME
    said = []
    for pause in (0.0, 0.0, 0.6):
        time.sleep(pause)
        said.append(node.get_logger().warning('line', **seldom(0.5)))
    assert said == [True, False, True]
