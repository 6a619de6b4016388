"""Commanding a robot from the page: sliders, and the arrow keys."""

from __future__ import annotations

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.teleoperation import Teleoperation
from fetch_hand_sim.view.page.windows import ITEM_WIDTH, Send, say
from fetch_hand_sim.view.picture import Facts, Picture
from fetch_hand_sim.view.requests import SetCommand, SetCommanding
from msgs_spec.tasks import TaskSpec

_SELECTED = imgui.Vec4(0.1, 0.45, 0.85, 1.0)


class CommandPanel:
    """The part of the robot's panel that commands, where nobody else does.

    Args:
        send: Gets the commands.
    """

    def __init__(self, send: Send) -> None:
        self._send = send
        self._task = ''
        self._teleoperation: Teleoperation | None = None

    def draw(self, spec: TaskSpec, picture: Picture) -> None:
        """Draws it, and sends a command for every frame while it is switched on."""
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
    somebody = facts.commander not in ('', '-') and not facts.is_commanding
    if somebody:
        say(f'{facts.commander} commands. Stop it to take over.')
    imgui.BeginDisabled(somebody)
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
    # What is typed into a field is no command.
    is_free = not imgui.IsAnyItemActive()
    if is_free and imgui.IsKeyPressed(key.UpArrow):
        teleoperation.select(-1)
    if is_free and imgui.IsKeyPressed(key.DownArrow):
        teleoperation.select(1)
    direction = int(imgui.IsKeyDown(key.RightArrow)) - int(imgui.IsKeyDown(key.LeftArrow))
    teleoperation.hold(direction if is_free else 0, imgui.GetIO().DeltaTime)
