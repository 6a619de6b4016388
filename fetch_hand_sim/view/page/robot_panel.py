"""What the robot does in words, and what one may do to it."""

from __future__ import annotations

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.command_panel import CommandPanel
from fetch_hand_sim.view.page.goal_panel import draw_goal_sliders
from fetch_hand_sim.view.page.introduction import drag_hint, introduction
from fetch_hand_sim.view.page.push_panel import PushPanel
from fetch_hand_sim.view.page.time_controls import draw_pause, draw_speed, draw_step
from fetch_hand_sim.view.page.windows import ITEM_WIDTH, Send, say
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import ChooseActor, Reset
from msgs_spec.tasks import TaskSpec

_GREEN = imgui.Vec4(0.1, 0.55, 0.2, 1.0)
_RED = imgui.Vec4(0.75, 0.2, 0.15, 1.0)


class RobotPanel:
    """The panel, with what people have typed into it.

    Args:
        send: Gets what people ask for.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._seed = 0
        self._actor = 0
        self._task = ''
        self._command_panel = CommandPanel(send)
        self._push_panel = PushPanel(send)
        self.keeps_goal = True

    def draw(self, spec: TaskSpec, picture: Picture) -> None:
        """Draws its content."""
        facts = picture.facts
        if self._task != spec.name:
            self._task, self._actor = spec.name, 0
        say(introduction(spec))
        if facts.source == 'live' and facts.may_command:
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
        self._draw_time(facts)
        if facts.actors:
            self._draw_actors(facts)
        if picture.frame is not None and imgui.CollapsingHeader('Goal'):
            self.keeps_goal = imgui.Checkbox('Keep my goal in new episodes', self.keeps_goal)[1]
            draw_goal_sliders(spec, picture.frame.desired_goal, self.keeps_goal, self._send)
        self._command_panel.draw(spec, picture)
        if facts.push_limit and imgui.CollapsingHeader('Push it'):
            self._push_panel.draw(spec, facts.push_limit)

    def _draw_time(self, facts: Facts) -> None:
        draw_pause(facts.is_paused, 'Run', self._send)
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
        draw_speed(facts.speed, self._send)

    def _draw_actors(self, facts: Facts) -> None:
        imgui.SetNextItemWidth(ITEM_WIDTH)
        changed, self._actor = imgui.Combo('actor', self._actor, list(facts.actors))
        if changed:
            self._send(ChooseActor(facts.actors[self._actor]))


def _draw_state(spec: TaskSpec, picture: Picture) -> None:
    facts = picture.facts
    if picture.frame is None:
        say('The robot waits for somebody who commands it.')
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
        imgui.Text(f'{state}, {facts.missed_ticks} missed')
