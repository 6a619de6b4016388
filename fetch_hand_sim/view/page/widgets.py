"""Windows, text and buttons that several panels use."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.requests import Request, SetPaused, SetSpeed, StepOnce

Send = Callable[[Request], None]

# Pixels. Items leave room for their names.
MARGIN = 10.0
WIDTH = 330.0
ITEM_WIDTH = 210.0
_LETTERS = 46
_SPEEDS = (0.1, 0.25, 0.5, 1.0, 2.0, 5.0)
_AS_FAST_AS_POSSIBLE = 0.0


class Windows:
    """Windows of the page that the user can hide."""

    def __init__(self) -> None:
        self._hidden: set[str] = set()
        self._has_folded = False

    def fold_once(self, *names: str) -> None:
        """Hide the windows with these titles at the first call; later calls do nothing."""
        if not self._has_folded:
            self._has_folded = True
            self._hidden.update(names)

    @contextmanager
    def column(self, title: str, x: float, y: float, height: float = 0.0) -> Iterator[bool]:
        """Draw a window of width `WIDTH`; yield whether to draw its content.

        If the user has hidden the window, yield False and draw a button that shows it again.

        Args:
            title: Title, which may change; text after `###` identifies the window.
            x: Left edge, pixels.
            y: Upper edge, pixels.
            height: Pixels; 0 fits the content.
        """
        name = title.partition('###')[0]
        if name in self._hidden:
            with untitled_window(f'show {name}', x, y, 0.0, 0.0) as is_shown:
                if is_shown and imgui.Button(name):
                    self._hidden.discard(name)
            yield False
            return
        _place(x, y, WIDTH, height)
        is_shown, is_open = imgui.Begin(title, True, _flags())
        if not is_open:
            self._hidden.add(name)
        try:
            yield bool(is_shown)
        finally:
            imgui.End()


@contextmanager
def untitled_window(name: str, x: float, y: float, width: float, height: float) -> Iterator[bool]:
    """Draw a window without title that cannot be hidden; yield whether to draw its content.

    `name` identifies the window. Positions and sizes are pixels; a size of 0 fits the content.
    """
    _place(x, y, width, height)
    flags = _flags() | int(imgui.WindowFlags.NoTitleBar) | int(imgui.WindowFlags.NoScrollbar)
    try:
        yield bool(imgui.Begin(f'###{name}', flags=flags)[0])
    finally:
        imgui.End()


def say(text: str) -> None:
    """Draw text, wrapped to lines of 46 characters; ImGui cannot wrap the browser's font."""
    for line in textwrap.wrap(text, _LETTERS):
        imgui.Text(line)


def draw_pause(is_paused: bool, resume: str, send: Send) -> None:
    """Draw a button that sends `SetPaused`; its label is `Pause`, or `resume` while paused."""
    if imgui.Button(resume if is_paused else 'Pause'):
        send(SetPaused(not is_paused))


def draw_step(label: str, frames: int, send: Send) -> None:
    """Draw a button that runs one tick of a robot, or moves the playhead of a file by `frames`."""
    if imgui.Button(label):
        send(StepOnce(frames))


def draw_speed(speed: float, send: Send) -> None:
    """Draw a menu of speeds, simulated seconds per second; 0 is as fast as possible."""
    speeds = sorted({*_SPEEDS, speed})
    imgui.SetNextItemWidth(90.0)
    names = ['fastest' if each == _AS_FAST_AS_POSSIBLE else f'x {each:g}' for each in speeds]
    changed, chosen = imgui.Combo('##speed', speeds.index(speed), names)
    if changed:
        send(SetSpeed(speeds[chosen]))


def _place(x: float, y: float, width: float, height: float) -> None:
    imgui.SetNextWindowPos(imgui.Vec2(x, y), int(imgui.Cond.Always))
    imgui.SetNextWindowSize(imgui.Vec2(width, height), int(imgui.Cond.Always))


def _flags() -> int:
    flags = imgui.WindowFlags
    return int(flags.NoMove) | int(flags.NoResize) | int(flags.NoSavedSettings)
