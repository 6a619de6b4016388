"""Following a robot over its topics, also one that comes back as another."""

from __future__ import annotations

import time

import numpy as np
import pytest
import rclpy

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.view.robot_watch import RobotWatch
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.ros import rclpy_profile, ros_message_class
from msgs_spec.tick import TickEncoder


class Robot:
    """Publishes ticks as `sim_node` does."""

    def __init__(self, node, simulation, prefix, first_stamp_ns):
        self._node = node
        self._runner = EpisodeRunner(simulation, joint_prefix=prefix, first_stamp_ns=first_stamp_ns)
        self._encoder = TickEncoder(self._runner.spec)
        self._publishers = {}

    def tick(self):
        """Publishes a tick; returns its stamp and joints."""
        tick = self._runner.advance(self._runner.resting_command())
        for source, data in self._encoder.encode(tick, latched=tick.status.phase != 'running'):
            self._publisher(source).publish(data)
        return tick.stamp_ns, tick.readings['joint_states'][: len(self._runner.spec.robot.joints)]

    def leave(self):
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def _publisher(self, source):
        if source.name not in self._publishers:
            self._publishers[source.name] = self._node.create_publisher(
                ros_message_class(source.type_name), source.name, rclpy_profile(source.qos)
            )
        return self._publishers[source.name]


@pytest.fixture
def node():
    rclpy.init()
    node = rclpy.create_node('watched')
    yield node
    node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize('every_tick', [True, False])
def test_a_robot_that_comes_back_with_other_joint_names_is_followed(node, every_tick):
    simulation, seen = Simulation('FetchReach', num_threads=1), []
    watch = RobotWatch(node, lambda status: None, seen.append, every_tick)
    for prefix, first_stamp_ns in ((JOINT_PREFIX, 0), ('rh_', 10**12)):
        robot, sent = Robot(node, simulation, prefix, first_stamp_ns), {}

        def is_shown(tick, sent=sent):
            return np.array_equal(tick.frame.joint_position, sent.get(tick.stamp_ns))

        deadline = time.monotonic() + 20.0
        while not any(map(is_shown, seen)):
            assert time.monotonic() < deadline, f'no tick of the robot with {prefix!r}'
            stamp_ns, joints = robot.tick()
            sent[stamp_ns] = joints
            rclpy.spin_once(node, timeout_sec=0.02)
        assert watch.joint_prefix == prefix
        robot.leave()
