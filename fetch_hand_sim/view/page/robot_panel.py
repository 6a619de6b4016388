"""The robot panel: the state of the robot as text, and controls."""

from __future__ import annotations

from pathlib import PurePath

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.command_panel import CommandPanel
from fetch_hand_sim.view.page.goal_drag import drag_hint
from fetch_hand_sim.view.page.goal_panel import GoalPanel
from fetch_hand_sim.view.page.widgets import (
    ITEM_WIDTH,
    Send,
    draw_pause,
    draw_speed,
    draw_step,
    say,
)
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import ChooseActor, Push, Reset
from msgs_spec.tasks import TaskSpec

_GREEN = imgui.Vec4(0.1, 0.55, 0.2, 1.0)
_RED = imgui.Vec4(0.75, 0.2, 0.15, 1.0)
_WAITING = 'The robot waits for its first command.'
_SILENT = 'The robot is silent: it has shut down, or hangs. This is its last state.'
_READ_ONLY = 'This page can only watch (--read-only).'
_INTRODUCTIONS = {
    'FetchReach': 'The arm brings its gripper to the red ball.',
    'FetchPush': 'The arm pushes the box to the red ball on the table.',
    'FetchSlide': 'The arm hits the puck so that it slides to the red ball, out of its reach.',
    'FetchPickAndPlace': 'The arm picks the box up and holds it at the red ball.',
    'HandReach': 'The hand brings its fingertips to the red balls: thumb and finger meet.',
}


def introduction(spec: TaskSpec) -> str:
    """Return the sentences that describe the task to the user."""
    text = _INTRODUCTIONS.get(spec.name)
    things = (word for word in ('Block', 'Egg', 'Pen') if f'HandManipulate{word}' in spec.name)
    if spec.formulas is None and (thing := next(things, '').lower()):
        how = ' and moves it there' if spec.position_counts else ''
        text = f'The hand turns the {thing} until it looks like the tinted ghost{how}.'
    text = text or f'{spec.name} is a third-party task.'
    return f'{text} The goal turns green when it is reached.'


class RobotPanel:
    """Draws state and controls of a robot or episode file; stores the values that users enter."""

    def __init__(self, send: Send, goal_panel: GoalPanel) -> None:
        self._send = send
        self._seed = 0
        self._goal_panel = goal_panel
        self._command_panel = CommandPanel(send)
        self._push_panel = PushPanel(send)

    def draw(self, spec: TaskSpec, picture: Picture) -> None:
        """Draw the content of the panel."""
        facts = picture.facts
        say(introduction(spec))
        if facts.takes_actions:
            say(f'{drag_hint(spec)}: the robot follows.')
            if facts.push_limit:
                say('Drag robot or object with Ctrl to pull at it.')
        if not facts.may_command:
            say(_READ_ONLY)
        imgui.Separator()
        _draw_state(spec, picture)
        if facts.source == 'live' and facts.may_command:
            self._draw_actions(spec, picture)
        if facts.notice:
            imgui.Separator()
            say(facts.notice)

    def _draw_actions(self, spec: TaskSpec, picture: Picture) -> None:
        facts = picture.facts
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
    """Draw a combo box of actors, also of an unlisted active one; pass a choice to `send`."""
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
        say('No tick has arrived yet.' if facts.is_replay else _WAITING)
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


class PushPanel:
    """Controls that choose a body and a force, and a button that pushes while it is held."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._body = 0
        self._force = np.zeros(3)

    def draw(self, spec: TaskSpec, limit: float) -> None:
        """Draw the panel for forces up to `limit`, N."""
        bodies = [spec.object_name] if spec.object_name else []
        bodies.append('robot0:gripper_link' if spec.robot.has_gripper_command else 'robot0:palm')
        imgui.SetNextItemWidth(ITEM_WIDTH)
        self._body = imgui.Combo('body', min(self._body, len(bodies) - 1), bodies)[1]
        for axis, name in enumerate('xyz'):
            imgui.SetNextItemWidth(ITEM_WIDTH)
            value = float(self._force[axis])
            self._force[axis] = imgui.SliderFloat(f'{name} (N)', value, -limit, limit)[1]
        length = float(np.linalg.norm(self._force))
        imgui.Button(f'Push with {min(length, limit):.1f} N while held')
        if imgui.IsItemActive() and length > 0.0:
            wrench = np.concatenate([self._force, np.zeros(3)])
            self._send(Push(bodies[self._body], wrench))
