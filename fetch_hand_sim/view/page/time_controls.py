"""Stop, step, faster: the same for a running robot and for a file."""

from __future__ import annotations

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.windows import Send
from fetch_hand_sim.view.requests import SetPaused, SetSpeed, StepOnce

_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0)
_AS_FAST_AS_POSSIBLE = 0.0


def draw_pause(is_paused: bool, go_on: str, send: Send) -> None:
    """A button that stops, or goes on."""
    if imgui.Button(go_on if is_paused else 'Pause'):
        send(SetPaused(not is_paused))


def draw_step(label: str, frames: int, send: Send) -> None:
    """A button that shows another tick."""
    if imgui.Button(label):
        send(StepOnce(frames))


def draw_speed(speed: float, send: Send) -> None:
    """A choice of speeds; one that another program has set is shown too."""
    speeds = sorted({*_SPEEDS, speed})
    imgui.SetNextItemWidth(90.0)
    names = ['fastest' if each == _AS_FAST_AS_POSSIBLE else f'x {each:g}' for each in speeds]
    changed, chosen = imgui.Combo('##speed', speeds.index(speed), names)
    if changed:
        send(SetSpeed(speeds[chosen]))
