"""Panels of the page: what the robot does in words and curves, and what one may do to it."""

from __future__ import annotations

import textwrap
from collections.abc import Callable

import numpy as np
from mujoco.studio.dear_imgui import dear_imgui as imgui
from numpy.typing import NDArray

from fetch_hand_sim.view.goal_panel import draw_goal_sliders
from fetch_hand_sim.view.messages import (
    ChooseActor,
    Facts,
    LatestRequest,
    Picture,
    Request,
    Reset,
    SetCommand,
    SetCommanding,
    SetPaused,
    SetSpeed,
    StepOnce,
)
from fetch_hand_sim.view.plots import draw_plots
from fetch_hand_sim.view.push_panel import PushPanel
from fetch_hand_sim.view.timeline import draw_timeline
from msgs_spec.actions import resting_command
from msgs_spec.tasks import GoalKind, TaskSpec, task_spec

Array = NDArray[np.float64]
Send = Callable[[Request | LatestRequest], None]

_MARGIN = 10.0
_WIDTH = 330.0
_LETTERS = 46
_GREEN = imgui.Vec4(0.1, 0.55, 0.2, 1.0)
_RED = imgui.Vec4(0.75, 0.2, 0.15, 1.0)
_SPEEDS = ('0.25', '0.5', '1', '2', '5')


def introduction(spec: TaskSpec) -> str:
    """A line for somebody who sees the robot for the first time."""
    what = {
        'FetchReach': 'The arm brings its gripper to the red ball.',
        'FetchPush': 'The arm pushes the box to the red ball on the table.',
        'FetchSlide': 'The arm hits the puck so that it slides to the red ball, out of its reach.',
        'FetchPickAndPlace': 'The arm picks the box up and holds it at the red ball.',
        'HandReach': 'The hand brings its fingertips to the red balls: thumb and finger meet.',
    }.get(spec.name)
    if spec.formulas is not None:
        what = f'{spec.name} is a task of another package.'
    if what is None:
        thing = next(word for word in ('block', 'egg', 'pen') if word in spec.name.lower())
        how = ' and moves it there' if spec.position_counts else ''
        what = f'The hand turns the {thing} until it looks like the tinted ghost{how}.'
    return f'{what} The goal turns green when it is reached.'


class Panels:
    """All panels, with what people have typed into them."""

    def __init__(self, send: Send) -> None:
        """Takes who gets what people ask for."""
        self._send = send
        self._seed = 0
        self._speed = 2
        self._actor = 0
        self._command: Array | None = None
        self._task = ''
        self._hidden: set[str] = set()
        self._push_panel = PushPanel(send)
        self.keeps_goal = True

    def draw(self, picture: Picture | None) -> None:
        """Draws everything for one frame."""
        if picture is None:
            _draw_waiting()
            return
        if picture.task != self._task:
            self._task, self._command, self._actor = picture.task, None, 0
        spec = task_spec(picture.task)
        size = imgui.GetIO().DisplaySize
        if self._begin(f'{spec.name}###robot', _MARGIN):
            self._draw_robot(spec, picture)
            imgui.End()
        if self._begin('Curves###curves', size.x - _WIDTH - _MARGIN):
            draw_plots(spec, picture.graphs, _WIDTH)
            imgui.End()
        if picture.timeline is not None:
            _place(_MARGIN, size.y - 84.0, size.x - 2.0 * _MARGIN, 74.0)
            if imgui.Begin('Timeline###timeline', flags=_flags() | _untitled())[0]:
                draw_timeline(picture.timeline, picture.facts, self._send)
            imgui.End()

    def _begin(self, title: str, x: float) -> bool:
        """Begins a panel that can be hidden; False where a button in its place shows it again."""
        name = title.partition('###')[0]
        if name in self._hidden:
            _place(x, _MARGIN, 0.0, 0.0)
            if imgui.Begin(f'###show {name}', flags=_flags() | _untitled())[0] and imgui.Button(
                name
            ):
                self._hidden.discard(name)
            imgui.End()
            return False
        _place(x, _MARGIN, _WIDTH, 0.0)
        is_shown, is_open = imgui.Begin(title, True, _flags())
        if not is_open:
            self._hidden.add(name)
        if not is_shown:
            imgui.End()
        return bool(is_shown)

    def drag_hint(self, spec: TaskSpec) -> str:
        """What dragging a goal does."""
        if spec.goal is not GoalKind.POSE:
            return 'Drag the goal'
        if not spec.position_counts:
            return 'Drag to turn the goal'
        return 'Drag to turn the goal, with Shift to move it'

    def _draw_robot(self, spec: TaskSpec, picture: Picture) -> None:
        facts = picture.facts
        _say(introduction(spec))
        if facts.source == 'live' and facts.may_command:
            _say(f'{self.drag_hint(spec)}: the robot follows.')
        imgui.Separator()
        _draw_state(spec, picture)
        if facts.source != 'live':
            return
        if not facts.may_command:
            imgui.TextDisabled('This page may only watch.')
            return
        imgui.Separator()
        self._draw_time(facts)
        self._draw_goal(spec, picture)
        self._draw_commands(spec, picture)
        if facts.push_limit and imgui.CollapsingHeader('Push it'):
            self._push_panel.draw(spec, facts.push_limit)
        if facts.notice:
            imgui.Separator()
            _say(facts.notice)

    def _draw_time(self, facts: Facts) -> None:
        if imgui.Button('Run' if facts.is_paused else 'Pause'):
            self._send(SetPaused(not facts.is_paused))
        imgui.SameLine()
        imgui.BeginDisabled(not facts.is_paused)
        if imgui.Button('Step'):
            self._send(StepOnce())
        imgui.EndDisabled()
        imgui.SameLine()
        if imgui.Button('New episode'):
            self._send(Reset())
        imgui.SetNextItemWidth(90.0)
        self._seed = max(0, imgui.InputInt('##seed', self._seed)[1])
        imgui.SameLine()
        if imgui.Button('With this seed'):
            self._send(Reset(self._seed))
        imgui.SetNextItemWidth(90.0)
        changed, self._speed = imgui.Combo('x real time', self._speed, list(_SPEEDS))
        if changed:
            self._send(SetSpeed(float(_SPEEDS[self._speed])))
        if facts.actors:
            self._draw_actors(facts)

    def _draw_actors(self, facts: Facts) -> None:
        imgui.SetNextItemWidth(210.0)
        changed, self._actor = imgui.Combo('actor', self._actor, list(facts.actors))
        if changed:
            self._send(ChooseActor(facts.actors[self._actor]))

    def _draw_goal(self, spec: TaskSpec, picture: Picture) -> None:
        if picture.frame is None or not imgui.CollapsingHeader('Goal'):
            return
        self.keeps_goal = imgui.Checkbox('Keep my goal in new episodes', self.keeps_goal)[1]
        draw_goal_sliders(spec, picture.frame.desired_goal, self.keeps_goal, self._send)

    def _draw_commands(self, spec: TaskSpec, picture: Picture) -> None:
        facts = picture.facts
        if not imgui.CollapsingHeader('Command it yourself'):
            return
        somebody = facts.commander not in ('', '-') and not facts.is_commanding
        if somebody:
            _say(f'{facts.commander} commands. Stop it to take over.')
        imgui.BeginDisabled(somebody)
        changed, on = imgui.Checkbox('My sliders command', facts.is_commanding)
        if changed:
            self._send(SetCommanding(on))
        imgui.EndDisabled()
        if not facts.is_commanding:
            self._command = None
            return
        if self._command is None:
            start = picture.command
            self._command = resting_command(spec.robot) if start is None else start.copy()
        for index, part in enumerate(spec.robot.command):
            label = part.name.removeprefix('robot0:')
            value = float(self._command[index])
            imgui.SetNextItemWidth(210.0)
            self._command[index] = imgui.SliderFloat(label, value, part.lower, part.upper)[1]
        self._send(SetCommand(self._command.copy()))


def _draw_waiting() -> None:
    size = imgui.GetIO().DisplaySize
    _place(size.x / 2.0 - _WIDTH / 2.0, size.y / 2.0 - 40.0, _WIDTH, 0.0)
    if imgui.Begin('###waiting', flags=_flags() | _untitled())[0]:
        _say('Waiting for a robot ...')
    imgui.End()


def _draw_state(spec: TaskSpec, picture: Picture) -> None:
    facts = picture.facts
    if picture.frame is None:
        _say('The robot waits for somebody who commands it.')
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
    _say(f'commands: {facts.commander or "-"}')
    if facts.source == 'live':
        state = 'paused' if facts.is_paused else f'{facts.rate:.2f} ticks/s'
        imgui.Text(f'{state}, {facts.missed_ticks} missed')


def _say(text: str) -> None:
    """Text over several lines; the browser's font is none that ImGui could wrap by itself."""
    for line in textwrap.wrap(text, _LETTERS):
        imgui.Text(line)


def _place(x: float, y: float, width: float, height: float) -> None:
    imgui.SetNextWindowPos(imgui.Vec2(x, y), int(imgui.Cond.Always))
    imgui.SetNextWindowSize(imgui.Vec2(width, height), int(imgui.Cond.Always))


def _flags() -> int:
    flags = imgui.WindowFlags
    return int(flags.NoMove) | int(flags.NoResize) | int(flags.NoSavedSettings)


def _untitled() -> int:
    flags = imgui.WindowFlags
    return int(flags.NoTitleBar) | int(flags.NoScrollbar)
