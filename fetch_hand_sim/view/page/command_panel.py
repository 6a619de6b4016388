"""Command a robot from the page: with sliders, and with the arrow keys."""

from __future__ import annotations

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.widgets import ITEM_WIDTH, Send, say
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import SetCommand, SetCommanding
from msgs_spec.arrays import Array
from msgs_spec.robots import CommandPart, RobotSpec, resting_command
from msgs_spec.tasks import TaskSpec

_SELECTED = imgui.Vec4(0.1, 0.45, 0.85, 1.0)
# Seconds in which a held key moves a slider from end to end.
_SWEEP = 2.0
# Units of relative commands begin with this: 'x 0.05 m' in each tick.
_MOVES = 'x '


def is_move(part: CommandPart) -> bool:
    """Return whether a part of the command is a motion per tick, as x, y and z of Fetch are."""
    return part.unit.startswith(_MOVES)


class Teleoperation:
    """Holds the command that the user changes with the sliders and arrow keys of the page.

    Args:
        start: (action size,) the last command of the robot; None for the resting command. Motions
            per tick (see `is_move`) begin at 0.

    Attributes:
        values: (action size,) the command, command units.
        selected: Index of the value that the keys change.
    """

    def __init__(self, robot: RobotSpec, start: Array | None) -> None:
        self._parts = robot.command
        self.values = resting_command(robot) if start is None else start.copy()
        for index, part in enumerate(self._parts):
            if is_move(part):
                self.values[index] = 0.0
        self.selected = 0
        self._held: int | None = None

    def select(self, by: int) -> None:
        """Move the selection by `by` values; after the last value comes the first."""
        self.selected = (self.selected + by) % len(self._parts)

    def hold(self, direction: int, seconds: float) -> None:
        """Change the selected value by an arrow key; call it in every frame, also without a key.

        A held key moves a target position through its range in 2 s. It sets a motion per tick (see
        `is_move`) to its upper or lower limit; a released key sets it to 0.

        Args:
            direction: -1 or 1 while a key is held, 0 without a key.
            seconds: Seconds since the last call.
        """
        if self._held is not None and (not direction or self._held != self.selected):
            self.values[self._held] = 0.0
            self._held = None
        if not direction:
            return
        part = self._parts[self.selected]
        if is_move(part):
            self._held = self.selected
            self.values[self.selected] = part.upper if direction > 0 else part.lower
            return
        step = direction * (part.upper - part.lower) * seconds / _SWEEP
        value = self.values[self.selected] + step
        self.values[self.selected] = min(max(value, part.lower), part.upper)


class CommandPanel:
    """The part of the robot panel with which the user commands the robot."""

    def __init__(self, send: Send) -> None:
        self._send = send
        self._task = ''
        self._teleoperation: Teleoperation | None = None

    def draw(self, spec: TaskSpec, picture: Picture) -> None:
        """Draw the panel; while its checkbox is on, send the sliders' command in every frame."""
        facts = picture.facts
        if self._task != spec.name or not facts.is_commanding:
            self._task, self._teleoperation = spec.name, None
        if facts.is_commanding:
            self._command(spec, picture)
        if not imgui.CollapsingHeader('Command it yourself'):
            return
        _draw_switch(facts, self._send)
        if self._teleoperation is not None:
            say('Arrow keys: up and down choose, left and right move.')
            _draw_sliders(spec, self._teleoperation)

    def _command(self, spec: TaskSpec, picture: Picture) -> None:
        if self._teleoperation is None:
            self._teleoperation = Teleoperation(spec.robot, picture.command)
        _take_keys(self._teleoperation)
        self._send(SetCommand(self._teleoperation.values.copy()))


def _draw_switch(facts: Facts, send: Send) -> None:
    has_other = facts.commander not in ('', '-') and not facts.is_commanding
    if has_other:
        say(f'{facts.commander} commands. Stop it to take over.')
    imgui.BeginDisabled(has_other or facts.is_silent)
    changed, on = imgui.Checkbox('My sliders command', facts.is_commanding)
    if changed:
        send(SetCommanding(on))
    imgui.EndDisabled()


def _draw_sliders(spec: TaskSpec, teleoperation: Teleoperation) -> None:
    for index, part in enumerate(spec.robot.command):
        imgui.SetNextItemWidth(ITEM_WIDTH)
        value = float(teleoperation.values[index])
        moved, value = imgui.SliderFloat(f'##{part.name}', value, part.lower, part.upper)
        if moved:
            teleoperation.selected = index
            teleoperation.values[index] = value
        imgui.SameLine()
        label = part.name.removeprefix('robot0:')
        if index == teleoperation.selected:
            imgui.TextColored(_SELECTED, f'< {label} >')
        else:
            imgui.Text(label)


def _take_keys(teleoperation: Teleoperation) -> None:
    key = imgui.Key
    # Arrow keys in an input field do not command.
    is_free = not imgui.IsAnyItemActive()
    if is_free and imgui.IsKeyPressed(key.UpArrow):
        teleoperation.select(-1)
    if is_free and imgui.IsKeyPressed(key.DownArrow):
        teleoperation.select(1)
    direction = int(imgui.IsKeyDown(key.RightArrow)) - int(imgui.IsKeyDown(key.LeftArrow))
    teleoperation.hold(direction if is_free else 0, imgui.GetIO().DeltaTime)
