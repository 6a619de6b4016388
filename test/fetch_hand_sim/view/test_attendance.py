"""Commands of the page end when its visitor leaves, and when the robot does."""

from __future__ import annotations

import asyncio
import socket
import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy
from websockets.asyncio.client import connect

from fetch_hand_sim.simulation.scene import Frame
from fetch_hand_sim.view import guard, live, robot_requests
from fetch_hand_sim.view.guard import Attendance, Guard, guarded_serve
from fetch_hand_sim.view.live import LiveRobot
from fetch_hand_sim.view.requests import ReleaseGoal, SetCommand, SetCommanding, SetGoal
from fetch_hand_sim.view.robot_requests import RemoteNode
from fetch_hand_sim.watch.robot_watch import SeenTick
from msgs_spec.tasks import task_spec
from support.random_ticks import episode_status


def test_a_silent_visitor_is_absent_and_a_departed_one_is_noticed_once():
    now = [100.0]
    attendance = Attendance(lambda: now[0])
    assert not attendance.is_there
    attendance.note()
    now[0] += 2.9
    assert attendance.is_there and not attendance.has_left()
    now[0] += 0.2
    assert not attendance.is_there and attendance.has_left()
    attendance.note()
    attendance.end_visit()
    # The next visitor takes control before `has_left` is read.
    attendance.note()
    assert attendance.is_there and attendance.has_left() and not attendance.has_left()


@pytest.mark.parametrize('path', ['/ui', '/state'])
def test_the_page_in_control_is_heard_and_a_hanging_one_is_left_in_time(path, monkeypatch):
    attendance, took, was_there = Attendance(), [], []

    async def handle(connection):
        async for _ in connection:
            was_there.append(attendance.is_there)
            began = time.monotonic()
            await connection.close()
            took.append(time.monotonic() - began)

    async def visit():
        own = socket.create_server(('127.0.0.1', 0))
        port = own.getsockname()[1]
        rules = {name: lambda *_: None for name in ('process_request', 'process_response')}
        serve = guarded_serve(Guard(), attendance)
        async with serve(handle, sock=own, close_timeout=None, **rules):
            url, origin = f'ws://127.0.0.1:{port}{path}?sid=1', f'http://127.0.0.1:{port}'
            async with connect(url, origin=origin) as visitor:
                assert not attendance.is_there
                # Hangs: what comes is not read, and no farewell confirmed.
                visitor.transport.pause_reading()
                await visitor.send(b'x')
                while not took:
                    await asyncio.sleep(0.05)
                visitor.transport.abort()

    monkeypatch.setattr(guard, '_CLOSE_TIMEOUT', 0.3)
    asyncio.run(asyncio.wait_for(visit(), 20.0))
    assert took[0] < 10.0 and was_there == [path == '/ui']
    assert not attendance.is_there


@pytest.fixture
def robot(node):
    return LiveRobot(node, may_command=True)


def follow(robot, stamps=(), **changes):
    """Show a status and ticks with these stamps to a page."""
    changes = {'episode': 0, 'tick': 0, 'phase': 'reset', 'control_hz': 25.0} | changes
    status = replace(episode_status(task_spec('FetchReach')), **changes)
    robot._watch.status = status
    robot._on_status(status)
    for stamp in stamps:
        goal = np.array([1.3, 0.7, 0.5])
        frame = Frame(np.zeros(15), goal, goal, None, is_success=True)
        robot._on_tick(SeenTick(stamp, frame, -1.0, np.zeros(4), None))


def test_commands_end_when_switched_off_and_when_visitor_task_or_robot_are_gone(
    node, robot, monkeypatch
):
    def facts_of_a_commander():
        robot.perform(SetCommanding(True))
        return robot.picture().facts

    follow(robot, [10])
    assert facts_of_a_commander().is_commanding
    robot.perform(SetCommand(np.ones(4)))
    assert node.count_publishers('/commands') == 1
    robot.perform(SetCommanding(False))
    robot.perform(SetCommand(np.ones(4)))
    assert node.count_publishers('/commands') == 0
    assert not robot.picture().facts.is_commanding
    assert facts_of_a_commander().is_commanding
    robot.leave()
    facts = robot.picture().facts
    assert not facts.is_commanding and 'the visitor left' in facts.notice
    robot.leave()
    assert robot.picture() is None
    assert facts_of_a_commander().is_commanding
    follow(robot, [20], task='FetchPush', episode=3)
    facts = robot.picture().facts
    assert not facts.is_commanding and 'restarted' in facts.notice
    assert facts_of_a_commander().is_commanding
    monkeypatch.setattr(live, '_SILENCE', 0.0)
    robot._look()
    facts = robot.picture().facts
    assert facts.is_silent and not facts.is_commanding and 'silent' in facts.notice
    assert not facts_of_a_commander().is_commanding


def test_a_notice_ends_with_its_episode(robot, monkeypatch):
    follow(robot, [10])
    robot.perform(ReleaseGoal())
    follow(robot, [20], tick=3, phase='running')
    robot._look()
    assert 'draws its own goal' in robot.picture().facts.notice
    follow(robot, [30], episode=1)
    robot._look()
    assert robot.picture().facts.notice, 'time to read it'
    monkeypatch.setattr(live, '_NOTICE_TIME', 0.0)
    robot._look()
    assert robot.picture().facts.notice == ''


def test_pictures_show_new_goals_at_once_and_nothing_of_an_earlier_robot(robot):
    follow(robot, [10**9, 2 * 10**9, 3 * 10**9])
    assert len(robot.picture().graphs.reward.times) == 3
    # A robot that stands still publishes no tick with the goal.
    goal = np.array([1.4, 0.8, 0.6])
    robot.perform(SetGoal(goal))
    np.testing.assert_array_equal(robot.picture().frame.desired_goal, goal)
    # Curves begin again where time goes back.
    follow(robot, [10**9], episode=1)
    assert robot.picture().graphs.reward.times.tolist() == [1.0]
    # A restarted robot with another rate; the page may miss that it waited.
    follow(robot, [2 * 10**9], episode=2, control_hz=50.0)
    picture = robot.picture()
    assert picture.facts.ticks == 100 and picture.graphs.reward.times.tolist() == [2.0]
    follow(robot, phase='waiting')
    assert robot.picture().frame is None


def test_a_hanging_node_is_asked_rarely(node, monkeypatch):
    asked = []

    class Hanging:
        def service_is_ready(self):
            return True

        def call_async(self, request):
            asked.extend(request.names)
            return rclpy.task.Future()

    remote = RemoteNode(node, 'sim_node', print)
    monkeypatch.setattr(remote, '_client', lambda *_: Hanging())
    for name in ('rate', 'rate', 'policy', 'rate'):
        remote.get_parameter(name, print)
    assert asked == ['rate', 'policy']
    # Another one may be in its place by now.
    monkeypatch.setattr(robot_requests, '_ANSWER_TIMEOUT', 0.0)
    remote.get_parameter('rate', print)
    assert asked == ['rate', 'policy', 'rate']
