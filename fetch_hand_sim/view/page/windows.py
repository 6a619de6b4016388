"""Windows of the page: where they are, and how to hide them."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.requests import LatestRequest, Request

Send = Callable[[Request | LatestRequest], None]

MARGIN = 10.0
WIDTH = 330.0
# Width of sliders and lists, pixels, which leaves room for their names.
ITEM_WIDTH = 210.0
_LETTERS = 46


class Windows:
    """Windows that can be hidden."""

    def __init__(self) -> None:
        """Shows all."""
        self._hidden: set[str] = set()
        self._has_folded = False

    def fold_once(self, *names: str) -> None:
        """Hides windows at the first call; what is shown again stays."""
        if not self._has_folded:
            self._has_folded = True
            self._hidden.update(names)

    @contextmanager
    def column(self, title: str, x: float, y: float, height: float = 0.0) -> Iterator[bool]:
        """A window of the usual width; False where a button in its place shows it again.

        Args:
            title: What it is called; what follows `###` names it where the title changes.
            x: Left edge, pixels.
            y: Upper edge, pixels.
            height: Pixels; 0 for what its content takes.
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
    """A window without a title that cannot be hidden; False where nothing of it is seen."""
    _place(x, y, width, height)
    flags = _flags() | int(imgui.WindowFlags.NoTitleBar) | int(imgui.WindowFlags.NoScrollbar)
    try:
        yield bool(imgui.Begin(f'###{name}', flags=flags)[0])
    finally:
        imgui.End()


def say(text: str) -> None:
    """Text over several lines; the browser's font is none that ImGui could wrap by itself."""
    for line in textwrap.wrap(text, _LETTERS):
        imgui.Text(line)


def _place(x: float, y: float, width: float, height: float) -> None:
    imgui.SetNextWindowPos(imgui.Vec2(x, y), int(imgui.Cond.Always))
    imgui.SetNextWindowSize(imgui.Vec2(width, height), int(imgui.Cond.Always))


def _flags() -> int:
    flags = imgui.WindowFlags
    return int(flags.NoMove) | int(flags.NoResize) | int(flags.NoSavedSettings)
