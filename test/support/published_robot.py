"""A robot whose topics a test publishes tick by tick."""

from __future__ import annotations

import time

import rclpy

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import DIAGNOSTICS
from node_runtime.diagnostics import Report, encode_reports
from node_runtime.ros import open_publisher

REPORT = {'mode': 'real time', 'paused': 'False', 'rate (Hz)': '25.00', 'commanders': '/somebody'}


class Robot:
    """Publishes ticks as `sim_node` does."""

    def __init__(self, node, task='FetchReach', prefix=JOINT_PREFIX, first_stamp_ns=0):
        self._node = node
        self._runner = EpisodeRunner(
            Simulation(task, num_threads=1), joint_prefix=prefix, first_stamp_ns=first_stamp_ns
        )
        self._encoder = TickEncoder(self._runner.spec)
        self._publishers = {}

    def tick(self, command=None, lost=()):
        """Publishes a tick, but not what is lost on the way; returns it."""
        tick = self._runner.advance(self._runner.resting_command() if command is None else command)
        for source, data in self._encoder.encode(tick, latched=tick.status.phase != 'running'):
            if source.name not in lost:
                self._publish(source, data)
        return tick

    def report(self, **changes):
        """Publishes diagnostics, as `sim_node` does every second."""
        report = Report('/sim_node', 'FetchReach', REPORT | changes, '')
        self._publish(DIAGNOSTICS, encode_reports(report))

    def leave(self):
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def _publish(self, source, data):
        if source.name not in self._publishers:
            self._publishers[source.name] = open_publisher(self._node, source)
        self._publishers[source.name].publish(data)


def act_until(node, act, condition, seconds=20.0):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        act()
        rclpy.spin_once(node, timeout_sec=0.02)
