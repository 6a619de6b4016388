"""Following a robot over its topics, also one that is gone or comes back as another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import rclpy

from fetch_hand_sim.watch.robot_watch import RobotWatch
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tasks import task_spec
from support.published_robot import Robot, act_until

JOINTS = len(task_spec('FetchReach').robot.joints)


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
