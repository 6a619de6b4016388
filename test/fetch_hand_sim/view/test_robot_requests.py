"""What the page may do to a robot, and what never leaves it."""

from __future__ import annotations

import time

import numpy as np
import pytest
import rclpy

from fetch_hand_sim.view.page import robot_panel, widgets
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import (
    ChooseActor,
    Push,
    SetCommand,
    SetCommanding,
    SetPaused,
    SetSpeed,
)
from fetch_hand_sim.view.robot_requests import RobotRequests
from fetch_hand_sim.view.robot_watch import Replay
from msgs_spec.codecs import decode
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic
from node_runtime.ros import rclpy_profile, ros_message_class

SPEC = task_spec('FetchPush')
WRENCH = np.array([30.0, 0.0, 40.0, 0.0, 0.0, 0.0])


class Desk:
    """The page's side and somebody who hears what it sends."""

    def __init__(self, name):
        self.node = rclpy.create_node('page')
        self.told = {}
        self.requests = RobotRequests(self.node, self.told.update)
        self.requests.take_task(SPEC)
        self.source, self.heard = topic(SPEC, name), []
        self.node.create_subscription(
            ros_message_class(self.source.type_name),
            name,
            self.heard.append,
            rclpy_profile(self.source.qos),
        )

    def count_publishers(self):
        return self.node.count_publishers(self.source.name)

    def wait_for_message(self):
        end = time.monotonic() + 20.0
        while not self.heard and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return self.heard[-1]


@pytest.fixture
def desk(request):
    rclpy.init()
    desk = Desk(request.param)
    yield desk
    desk.node.destroy_node()
    rclpy.shutdown()


@pytest.mark.parametrize('desk', ['perturb'], indirect=True)
def test_nothing_is_pushed_where_the_robot_takes_none(desk):
    desk.requests.perform(Push('object0', WRENCH))
    assert desk.count_publishers() == 0
    assert 'perturb_limit' in desk.told['notice']


@pytest.mark.parametrize('desk', ['perturb'], indirect=True)
def test_a_push_beyond_the_limit_leaves_within_it(desk):
    desk.requests.push_limit = 10.0
    desk.requests.perform(Push('object0', WRENCH))
    message = desk.wait_for_message()
    assert message.header.frame_id == 'object0'
    sent = decode(desk.source, message)
    np.testing.assert_allclose(sent, 0.2 * WRENCH, rtol=1e-6)
    assert np.linalg.norm(sent[:3]) <= 10.0


@pytest.mark.parametrize('desk', ['perturb'], indirect=True)
def test_replays_that_come_and_go_leave_nothing_behind(desk):
    before = len(list(desk.node.clients))
    for number in range(3):
        desk.requests.take_replay(Replay(f'/replay{number}', f'/replay{number}/pause'))
        desk.requests.perform(SetPaused(True))
        assert len(list(desk.node.clients)) > before
    desk.requests.take_replay(None)
    assert len(list(desk.node.clients)) == before


@pytest.mark.parametrize('desk', ['commands'], indirect=True)
def test_sliders_command_only_while_they_are_switched_on(desk):
    values = np.array([0.1, 0.2, 0.3, -1.0])
    desk.requests.perform(SetCommand(values))
    assert desk.count_publishers() == 0
    desk.requests.perform(SetCommanding(True))
    desk.requests.perform(SetCommand(values))
    np.testing.assert_array_equal(decode(desk.source, desk.wait_for_message()), values)
    desk.requests.perform(SetCommanding(False))
    desk.requests.perform(SetCommand(values))
    assert desk.count_publishers() == 0
    assert desk.told['is_commanding'] is False


@pytest.mark.parametrize('desk', ['perturb'], indirect=True)
def test_who_does_not_answer_is_not_paused(desk):
    desk.requests.perform(SetPaused(True))
    assert desk.told == {'notice': 'sim_node does not answer'}
    desk.requests.perform(SetSpeed(2.0))
    assert 'speed' not in desk.told


class Choice:
    """An ImGui in which somebody chooses an entry of a list, by its name."""

    def __init__(self, name=None):
        self.name, self.shown, self.names = name, '', []

    def __getattr__(self, name):
        return lambda *arguments: None

    def Combo(self, label, index, names):
        self.shown, self.names = names[index], names
        wanted = index if self.name is None else names.index(self.name)
        # It reports only changes.
        return wanted != index, wanted


ACTORS = ('FetchPush', 'random', 'resting')


@pytest.mark.parametrize('actor', [*ACTORS, '/home/me/best.safetensors', ''])
@pytest.mark.parametrize('wanted', ACTORS)
def test_every_choice_of_an_actor_is_a_change(monkeypatch, actor, wanted):
    sent = []
    monkeypatch.setattr(robot_panel, 'imgui', choice := Choice(wanted))
    robot_panel.draw_actors(Facts(actors=ACTORS, actor=actor), sent.append)
    assert choice.shown == {'/home/me/best.safetensors': 'best.safetensors', '': '-'}.get(
        actor, actor
    )
    assert sent == ([] if actor == wanted else [ChooseActor(wanted)])


@pytest.mark.parametrize(
    ('speed', 'shown'), [(1.0, 'x 1'), (0.123, 'x 0.123'), (3.0, 'x 3'), (0.0, 'fastest')]
)
def test_any_speed_is_shown(monkeypatch, speed, shown):
    monkeypatch.setattr(widgets, 'imgui', choice := Choice())
    widgets.draw_speed(speed, lambda request: pytest.fail(f'{request} is no choice'))
    assert choice.shown == shown and 'x 5' in choice.names


@pytest.mark.parametrize('is_silent', [True, False])
def test_the_page_says_of_a_robot_that_it_is_gone(is_silent, monkeypatch):
    said = []
    monkeypatch.setattr(robot_panel, 'imgui', Choice())
    monkeypatch.setattr(robot_panel, 'say', said.append)
    facts = Facts(may_command=False, is_silent=is_silent)
    robot_panel.RobotPanel(None, None).draw(SPEC, Picture(SPEC.name, facts=facts))
    assert any('--read-only' in line for line in said)
    assert any('The robot is silent' in line for line in said) is is_silent
