"""Requests from the page to a robot: which are sent and which are refused."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
import rclpy

from fetch_hand_sim.view.page import robot_panel, widgets
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import (
    ChooseActor,
    Push,
    SetPaused,
    SetSpeed,
)
from fetch_hand_sim.view.robot_requests import RobotRequests
from fetch_hand_sim.watch.replay_watch import Replay
from msgs_spec.codecs import decode
from msgs_spec.tasks import task_spec
from msgs_spec.topics import topic
from node_runtime.ros import subscribe

SPEC = task_spec('FetchPush')
WRENCH = np.array([30.0, 0.0, 40.0, 0.0, 0.0, 0.0])


class Desk:
    """The requests of a page to a robot, with the facts that the page shows."""

    def __init__(self, node):
        self.node, self.facts = node, Facts()
        self.requests = RobotRequests(node, self.tell)
        self.requests.take_task(SPEC)

    def tell(self, **changes):
        self.facts = replace(self.facts, **changes)

    def perform(self, request):
        self.requests.perform(request, self.facts)


@pytest.fixture
def desk(node):
    return Desk(node)


def test_a_push_stays_within_the_limit_of_the_robot(desk):
    desk.perform(Push('object0', WRENCH))
    assert desk.node.count_publishers('/perturb') == 0
    assert 'perturb_limit' in desk.facts.notice
    desk.tell(push_limit=10.0)
    source, received = topic(SPEC, 'perturb'), []
    subscribe(desk.node, source, received.append)
    desk.perform(Push('object0', WRENCH))
    end = time.monotonic() + 20.0
    while not received:
        assert time.monotonic() < end
        rclpy.spin_once(desk.node, timeout_sec=0.1)
    (message,) = received
    sent = decode(source, message)
    assert message.header.frame_id == 'object0'
    np.testing.assert_allclose(sent, 0.2 * WRENCH, rtol=1e-6)
    assert np.linalg.norm(sent[:3]) <= 10.0


def test_a_node_that_does_not_answer_is_not_paused_and_replays_leave_nothing_behind(desk):
    desk.perform(SetPaused(True))
    assert desk.facts == Facts(notice='sim_node does not answer')
    desk.perform(SetSpeed(2.0))
    assert desk.facts.speed == 1.0
    before = len(list(desk.node.clients))
    for number in range(3):
        desk.requests.take_replay(Replay(f'/replay{number}', f'/replay{number}/pause'))
        desk.perform(SetPaused(True))
        assert len(list(desk.node.clients)) > before
    desk.requests.take_replay(None)
    assert len(list(desk.node.clients)) == before


class Choice:
    """Stands for ImGui: the user chooses an entry of a list by its name."""

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
def test_the_page_shows_that_a_robot_is_gone(is_silent, monkeypatch):
    said = []
    monkeypatch.setattr(robot_panel, 'imgui', Choice())
    monkeypatch.setattr(robot_panel, 'say', said.append)
    facts = Facts(may_command=False, is_silent=is_silent)
    robot_panel.RobotPanel(None, None).draw(SPEC, Picture(SPEC.name, facts=facts))
    assert any('--read-only' in line for line in said)
    assert any('The robot is silent' in line for line in said) is is_silent
