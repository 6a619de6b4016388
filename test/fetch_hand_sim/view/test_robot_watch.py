"""Following a robot over its topics, also one that is gone or comes back as another."""

from __future__ import annotations

import time
from dataclasses import replace

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
from node_runtime.ros import open_publisher, subscribe

JOINTS = len(task_spec('FetchReach').robot.joints)
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


@pytest.mark.parametrize('every_tick', [True, False])
def test_a_robot_that_comes_back_with_other_joint_names_is_followed(node, every_tick):
    seen = []
    watch = RobotWatch(node, lambda status: None, seen.append, every_tick)
    for prefix, first_stamp_ns in ((JOINT_PREFIX, 0), ('rh_', 10**12)):
        robot, sent = Robot(node, 'FetchReach', prefix, first_stamp_ns), {}

        def tick(robot=robot, sent=sent):
            tick = robot.tick()
            sent[tick.stamp_ns] = tick.readings['joint_states'][:JOINTS]

        def is_shown(sent=sent):
            return any(np.array_equal(t.frame.joint_position, sent.get(t.stamp_ns)) for t in seen)

        act_until(node, tick, is_shown)
        assert watch.status.joint_prefix == prefix
        robot.leave()


def test_a_robot_without_some_joints_and_success_is_shown(node, monkeypatch):
    seen, robot = [], Robot(node)
    watch, advance = RobotWatch(node, lambda status: None, seen.append), robot._runner.advance

    def without_base(command):
        tick = advance(command)
        joints = np.concatenate([np.full(3, np.nan), tick.readings['joint_states'][3:]])
        return replace(tick, readings={**tick.readings, 'joint_states': joints})

    monkeypatch.setattr(robot._runner, 'advance', without_base)
    act_until(node, lambda: robot.tick(lost=('is_success',)), lambda: seen)
    assert watch.status.joint_prefix == JOINT_PREFIX
    assert not seen[0].frame.is_success
    assert seen[0].frame.joint_position[:3].tolist() == [0.0] * 3
    assert np.isfinite(seen[0].frame.joint_position).all()


def test_a_tick_that_lost_its_first_message_does_not_pass_for_the_one_before(node):
    """State comes best effort: a viewer that gets no processor for a while loses some of it."""
    seen, sent = [], {}
    watch = RobotWatch(node, lambda status: None, seen.append)
    robot = Robot(node)

    def tick():
        for lost in ((), (), ('applied_command',), ('joint_states',), (), ('achieved_goal',)):
            tick = robot.tick(np.array([1.0, 0.3, -0.2, 0.0]), lost)
            sent[tick.stamp_ns] = tick, lost
            for _ in range(12):
                rclpy.spin_once(node, timeout_sec=0.002)

    act_until(node, tick, lambda: len(seen) >= 40)
    assert watch.status.joint_prefix == JOINT_PREFIX
    for each in seen:
        tick, lost = sent[each.stamp_ns]
        assert np.array_equal(each.frame.achieved_goal, tick.achieved_goal)
        assert np.array_equal(each.frame.joint_position, tick.readings['joint_states'][:JOINTS])
        assert 'joint_states' not in lost and 'achieved_goal' not in lost


def test_the_last_tick_before_a_pause_is_shown_also_without_one_of_its_messages(node):
    seen, robot = [], Robot(node)
    watch = RobotWatch(node, lambda status: None, seen.append)
    act_until(node, robot.tick, lambda: len(seen) > 3)
    assert watch.status.phase == 'reset'
    last = robot.tick(lost=('applied_command',))
    act_until(node, lambda: None, lambda: seen[-1].stamp_ns == last.stamp_ns)
    assert seen[-1].command is None and seen[-1].reward == last.reward


class Page:
    """A viewer of a robot with its latest picture."""

    def __init__(self, node):
        self.node, self.viewer = node, live.LiveRobot(node, may_command=True)
        self.picture = None

    def act_until(self, act, condition, seconds=20.0):
        def holds():
            self.picture = self.viewer.picture() or self.picture
            return self.picture is not None and condition(self.picture)

        act_until(self.node, act, holds, seconds)


@pytest.mark.parametrize('task', ['FetchReach', 'FetchPush'])
def test_commands_of_the_page_never_reach_the_next_robot(node, task):
    first, page, goals = Robot(node), Page(node), []
    page.act_until(first.tick, lambda picture: picture.frame is not None)
    page.viewer.perform(SetCommanding(True))
    page.viewer.perform(SetCommand(np.ones(4)))
    page.viewer.perform(SetGoal(np.array([1.3, 0.7, 0.5])))
    assert node.count_publishers('/commands') == 1
    first.leave()
    second = Robot(node, task)
    second.tick()
    page.viewer.perform(SetCommand(np.ones(4)))
    assert node.count_publishers('/commands') == 0
    subscribe(node, topic(task_spec(task), 'set_goal'), goals.append)
    page.act_until(second.tick, lambda p: p.task == task and p.facts.episode > 0)
    # Made for a robot with another goal.
    page.viewer.perform(SetGoal(np.zeros(15)))
    page.act_until(second.tick, lambda p: p.facts.episode > 1)
    assert not page.picture.facts.is_commanding
    assert not goals, 'the goal was kept for the first robot'


def test_the_page_shows_that_a_robot_is_silent_and_that_it_is_back(node, monkeypatch):
    monkeypatch.setattr(live, '_SILENCE', 1.5)
    robot, page = Robot(node), Page(node)

    def is_seen(picture):
        return picture.facts.commander == '/somebody' and not picture.facts.is_silent

    page.act_until(lambda: (robot.tick(), robot.report()), is_seen)
    # A robot that stands still publishes reports alone.
    end = time.monotonic() + 2.5
    page.act_until(robot.report, lambda picture: time.monotonic() > end)
    assert is_seen(page.picture)
    page.act_until(lambda: None, lambda picture: picture.facts.is_silent)
    assert (page.picture.facts.rate, page.picture.facts.commander) == (0.0, '')
    page.act_until(robot.report, is_seen)
    assert page.picture.facts.has_speed
    page.act_until(lambda: robot.report(mode='lockstep'), lambda p: not p.facts.has_speed)
