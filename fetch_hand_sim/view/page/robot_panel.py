"""What the robot does in words, and what one may do to it."""

from __future__ import annotations

from pathlib import PurePath

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.command_panel import CommandPanel
from fetch_hand_sim.view.page.goal_panel import GoalPanel
from fetch_hand_sim.view.page.introduction import drag_hint, introduction
from fetch_hand_sim.view.page.push_panel import PushPanel
from fetch_hand_sim.view.page.time_controls import draw_pause, draw_speed, draw_step
from fetch_hand_sim.view.page.windows import ITEM_WIDTH, Send, say
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import ChooseActor, Reset
from msgs_spec.tasks import TaskSpec

_GREEN = imgui.Vec4(0.1, 0.55, 0.2, 1.0)
_RED = imgui.Vec4(0.75, 0.2, 0.15, 1.0)
_WAITING = 'The robot waits for somebody who commands it.'
_SILENT = 'Nothing is heard of the robot: it has ended, or hangs. This is what it did last.'


class RobotPanel:
    """The panel, with what people have typed into it.

    Args:
        send: Gets what people ask for.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._seed = 0
        self._goal_panel = GoalPanel(send)
        self._command_panel = CommandPanel(send)
        self._push_panel = PushPanel(send)

    @property
    def keeps_goal(self) -> bool:
        """Whether goals that people set are for later episodes as well."""
        return self._goal_panel.keeps_goal

    def draw(self, spec: TaskSpec, picture: Picture) -> None:
        """Draws its content."""
        facts = picture.facts
        say(introduction(spec))
        if facts.takes_actions:
            say(f'{drag_hint(spec)}: the robot follows.')
            if facts.push_limit:
                say('Drag robot or object with Ctrl to pull at it.')
        imgui.Separator()
        _draw_state(spec, picture)
        if facts.source == 'live':
            self._draw_actions(spec, picture)
        if facts.notice:
            imgui.Separator()
            say(facts.notice)

    def _draw_actions(self, spec: TaskSpec, picture: Picture) -> None:
        facts = picture.facts
        if not facts.may_command:
            imgui.TextDisabled('This page may only watch.')
            return
        imgui.Separator()
        draw_pause(facts.is_paused, 'Run', self._send)
        if facts.is_replay:
            draw_speed(facts.speed, self._send)
            return
        self._draw_episode(facts)
        if facts.has_speed:
            draw_speed(facts.speed, self._send)
        if facts.actors:
            draw_actors(facts, self._send)
        if picture.frame is not None and imgui.CollapsingHeader('Goal'):
            self._goal_panel.draw(spec, picture.frame.desired_goal)
        self._command_panel.draw(spec, picture)
        if facts.push_limit and imgui.CollapsingHeader('Push it'):
            self._push_panel.draw(spec, facts.push_limit)

    def _draw_episode(self, facts: Facts) -> None:
        imgui.SameLine()
        imgui.BeginDisabled(not facts.is_paused)
        draw_step('Step', 1, self._send)
        imgui.EndDisabled()
        imgui.SameLine()
        if imgui.Button('New episode'):
            self._send(Reset())
        imgui.SetNextItemWidth(90.0)
        self._seed = max(0, imgui.InputInt('##seed', self._seed)[1])
        imgui.SameLine()
        if imgui.Button('With this seed'):
            self._send(Reset(self._seed))


def draw_actors(facts: Facts, send: Send) -> None:
    """A choice of actors that begins with who acts, so that whatever is chosen is a change."""
    names, index = list(facts.actors), 0
    if facts.actor in names:
        index = names.index(facts.actor)
    else:
        names.insert(0, PurePath(facts.actor).name or '-')
    imgui.SetNextItemWidth(ITEM_WIDTH)
    changed, index = imgui.Combo('actor', index, names)
    if changed and names[index] in facts.actors:
        send(ChooseActor(names[index]))


def _draw_state(spec: TaskSpec, picture: Picture) -> None:
    facts = picture.facts
    if facts.is_silent:
        say(_SILENT)
    elif picture.frame is None:
        say('Nothing is seen yet.' if facts.is_replay else _WAITING)
    elif picture.frame.is_success:
        imgui.TextColored(_GREEN, 'Goal reached')
    else:
        imgui.TextColored(_RED, 'Not at the goal')
    distances, rotations = picture.graphs.distance, picture.graphs.rotation
    if distances is not None and len(distances.values):
        distance = 1e3 * distances.values[-1]
        imgui.Text(f'distance  {distance:6.1f} mm   (below {1e3 * spec.distance_threshold:g})')
    if rotations is not None and len(rotations.values):
        degrees = np.degrees(rotations.values[-1])
        limit = np.degrees(spec.rotation_threshold or 0.0)
        imgui.Text(f'rotation  {degrees:6.1f} deg  (below {limit:.1f})')
    imgui.Text(f'episode {facts.episode}   seed {facts.seed}   step {facts.tick}/{facts.ticks}')
    imgui.Text(f'return {facts.episode_return:g}')
    say(f'commands: {facts.commander or "-"}')
    if facts.source == 'live':
        state = 'paused' if facts.is_paused else f'{facts.rate:.2f} ticks/s'
        imgui.Text(state if facts.is_replay else f'{state}, {facts.missed_ticks} missed')
