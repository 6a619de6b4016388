"""Following a robot over its topics, also one that is gone or comes back as another."""

from __future__ import annotations

import time

import numpy as np
import pytest
import rclpy

from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.view import live
from fetch_hand_sim.view.requests import SetCommand, SetCommanding, SetGoal
from fetch_hand_sim.view.robot_watch import RobotWatch
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tasks import task_spec
from msgs_spec.tick import TickEncoder
from msgs_spec.topics import DIAGNOSTICS, topic
from node_runtime.diagnostics import Report, encode_reports
from node_runtime.ros import rclpy_profile, ros_message_class

JOINTS = len(task_spec('FetchReach').robot.joints)


class Robot:
    """Publishes ticks as `sim_node` does."""

    def __init__(self, node, simulation, prefix, first_stamp_ns):
        self._node = node
        self._runner = EpisodeRunner(simulation, joint_prefix=prefix, first_stamp_ns=first_stamp_ns)
        self._encoder = TickEncoder(self._runner.spec)
        self._publishers = {}

    def tick(self, command=None, lost=()):
        """Publishes a tick, but not what is lost on the way; returns it."""
        tick = self._runner.advance(self._runner.resting_command() if command is None else command)
        for source, data in self._encoder.encode(tick, latched=tick.status.phase != 'running'):
            if source.name not in lost:
                self._publisher(source).publish(data)
        return tick

    def report(self, values):
        """Says something of itself, as `sim_node` does every second."""
        report = Report('/sim_node', 'FetchReach', values, '')
        self._publisher(DIAGNOSTICS).publish(encode_reports(report))

    def leave(self):
        for publisher in self._publishers.values():
            self._node.destroy_publisher(publisher)

    def _publisher(self, source):
        if source.name not in self._publishers:
            self._publishers[source.name] = self._node.create_publisher(
                ros_message_class(source.type_name), source.name, rclpy_profile(source.qos)
            )
        return self._publishers[source.name]


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
            tick = robot.tick()
            sent[tick.stamp_ns] = tick.readings['joint_states'][:JOINTS]
            rclpy.spin_once(node, timeout_sec=0.02)
        assert watch.joint_prefix == prefix
        robot.leave()


def test_a_tick_that_lost_its_first_message_does_not_pass_for_the_one_before(node):
    """State comes best effort: a viewer that gets no processor for a while loses some of it."""
    simulation, seen = Simulation('FetchReach', num_threads=1), []
    watch = RobotWatch(node, lambda status: None, seen.append)
    robot, sent = Robot(node, simulation, JOINT_PREFIX, 0), {}
    losses = [(), (), ('applied_command',), ('joint_states',), (), ('achieved_goal',)]
    deadline = time.monotonic() + 20.0
    while len(seen) < 40:
        assert time.monotonic() < deadline, f'{len(seen)} ticks were seen'
        for lost in losses:
            tick = robot.tick(np.array([1.0, 0.3, -0.2, 0.0]), lost)
            sent[tick.stamp_ns] = tick, lost
            for _ in range(12):
                rclpy.spin_once(node, timeout_sec=0.002)
    assert watch.joint_prefix == JOINT_PREFIX
    for each in seen:
        tick, lost = sent[each.stamp_ns]
        assert np.array_equal(each.frame.achieved_goal, tick.achieved_goal)
        assert np.array_equal(each.frame.joint_position, tick.readings['joint_states'][:JOINTS])
        assert 'joint_states' not in lost and 'achieved_goal' not in lost


@pytest.mark.parametrize('task', ['FetchReach', 'FetchPush'])
def test_commands_of_the_page_never_reach_the_next_robot(node, task):
    first = Robot(node, Simulation('FetchReach', num_threads=1), JOINT_PREFIX, 0)
    viewer = live.LiveRobot(node, may_command=True)

    def wait_for(condition, act):
        deadline, picture = time.monotonic() + 20.0, None
        while picture is None or not condition(picture):
            assert time.monotonic() < deadline
            act()
            rclpy.spin_once(node, timeout_sec=0.02)
            picture = viewer.picture() or picture

    wait_for(lambda picture: picture.frame is not None, first.tick)
    viewer.perform(SetCommanding(True))
    viewer.perform(SetCommand(np.ones(4)))
    viewer.perform(SetGoal(np.array([1.3, 0.7, 0.5])))
    assert node.count_publishers('/commands') == 1
    first.leave()
    second = Robot(node, Simulation(task, num_threads=1), JOINT_PREFIX, 0)
    second.tick()
    viewer.perform(SetCommand(np.ones(4)))
    assert node.count_publishers('/commands') == 0
    sent = []
    source = topic(task_spec(task), 'set_goal')
    node.create_subscription(
        ros_message_class(source.type_name), 'set_goal', sent.append, rclpy_profile(source.qos)
    )

    def is_over(picture):
        return picture.task == task and picture.facts.episode > 0

    wait_for(is_over, second.tick)
    assert not viewer.picture() or not viewer.picture().facts.is_commanding
    assert not sent, 'the goal was kept for the first robot'


REPORT = {'mode': 'real time', 'paused': 'False', 'rate (Hz)': '25.00', 'commanders': '/somebody'}


def test_the_page_says_so_when_nothing_is_heard_of_a_robot_any_more(node, monkeypatch):
    monkeypatch.setattr(live, '_SILENCE', 3.0)
    robot = Robot(node, Simulation('FetchReach', num_threads=1), JOINT_PREFIX, 0)
    viewer = live.LiveRobot(node, may_command=True)

    def facts_after(act, condition, patience=20.0):
        """What the page says once the condition holds, or after so many seconds."""
        deadline, facts = time.monotonic() + patience, None
        while time.monotonic() < deadline and not (facts and condition(facts)):
            act()
            rclpy.spin_once(node, timeout_sec=0.02)
            picture = viewer.picture()
            facts = picture.facts if picture else facts
        return facts

    def live_on():
        robot.tick()
        robot.report(REPORT)

    def is_told(facts):
        return facts.commander == '/somebody' and not facts.is_silent

    assert is_told(facts_after(live_on, is_told))
    # One that stands still reports, and no more.
    assert is_told(facts_after(lambda: robot.report(REPORT), lambda facts: False, 5.0))
    facts = facts_after(lambda: None, lambda facts: facts.is_silent)
    assert (facts.is_silent, facts.rate, facts.commander) == (True, 0.0, '')
    # It is heard again.
    facts = facts_after(lambda: robot.report(REPORT), is_told)
    assert is_told(facts) and facts.has_speed
    lockstep = REPORT | {'mode': 'lockstep'}
    facts = facts_after(lambda: robot.report(lockstep), lambda facts: not facts.has_speed)
    assert not facts.has_speed
