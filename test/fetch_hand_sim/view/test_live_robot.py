"""The page of a robot that leaves, comes back as another, or is silent."""

from __future__ import annotations

import time

import numpy as np
import pytest

from fetch_hand_sim.view import live
from fetch_hand_sim.view.requests import SetCommand, SetCommanding, SetGoal
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic
from node_runtime.ros import subscribe
from support.published_robot import Robot, act_until


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
