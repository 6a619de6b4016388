"""All panels of the page, and where they are."""

from __future__ import annotations

from pathlib import Path

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.view.page.episode_list import EpisodeList
from fetch_hand_sim.view.page.plots import draw_plots
from fetch_hand_sim.view.page.robot_panel import RobotPanel
from fetch_hand_sim.view.page.timeline import draw_timeline
from fetch_hand_sim.view.page.windows import (
    MARGIN,
    WIDTH,
    Send,
    Windows,
    say,
    untitled_window,
)
from fetch_hand_sim.view.picture import Facts, Graphs, Picture, Timeline
from msgs_spec.tasks import TaskSpec, task_spec

_TIMELINE_HEIGHT = 74.0
_LEAST_LIST = 100.0
# The narrowest page with room for two columns, pixels: a telephone that is held upright has none.
_TWO_COLUMNS = 2.0 * WIDTH + 3.0 * MARGIN
_BUTTON_HEIGHT = 3.0 * MARGIN


class Panels:
    """All panels, with what people have typed into them.

    Args:
        send: Gets what people ask for.
        episodes: What there is to choose from, of files.
    """

    def __init__(self, send: Send, episodes: tuple[Path, ...] = ()) -> None:
        self._send = send
        self._windows = Windows()
        self._robot_panel = RobotPanel(send)
        self._episode_list = EpisodeList(episodes, send)
        # Where the next window of the left column begins.
        self._below = 0.0

    @property
    def keeps_goal(self) -> bool:
        """Whether goals that people set are for later episodes as well."""
        return self._robot_panel.keeps_goal

    def draw(self, picture: Picture | None) -> None:
        """Draws everything for one frame."""
        size = imgui.GetIO().DisplaySize
        if picture is None:
            x, y = (size.x - WIDTH) / 2.0, size.y / 2.0 - 40.0
            with untitled_window('waiting', x, y, WIDTH, 0.0):
                say('Waiting for a robot ...')
            return
        spec = task_spec(picture.task)
        with self._windows.column(f'{spec.name}###robot', MARGIN, MARGIN) as is_shown:
            if is_shown:
                self._robot_panel.draw(spec, picture)
            self._below = MARGIN + _height(is_shown) + MARGIN
        self._draw_curves(spec, picture.graphs)
        if picture.timeline is not None:
            self._draw_file(picture.timeline, picture.facts)

    def _draw_curves(self, spec: TaskSpec, graphs: Graphs) -> None:
        """Draws them on the right, or where there is no room in the left column."""
        width = imgui.GetIO().DisplaySize.x
        is_narrow = width < _TWO_COLUMNS
        x, y = width - WIDTH - MARGIN, MARGIN
        if is_narrow:
            self._windows.fold_once('Curves', 'Episodes')
            x, y = MARGIN, self._below
        with self._windows.column('Curves###curves', x, y) as is_shown:
            if is_shown:
                draw_plots(spec, graphs, WIDTH)
            if is_narrow:
                self._below += _height(is_shown) + MARGIN

    def _draw_file(self, timeline: Timeline, facts: Facts) -> None:
        size = imgui.GetIO().DisplaySize
        top = size.y - _TIMELINE_HEIGHT - MARGIN
        if len(self._episode_list) > 1:
            height = max(top - self._below - MARGIN, _LEAST_LIST)
            with self._windows.column('Episodes', MARGIN, self._below, height) as is_shown:
                if is_shown:
                    self._episode_list.draw(timeline.number)
        width = size.x - 2.0 * MARGIN
        with untitled_window('timeline', MARGIN, top, width, _TIMELINE_HEIGHT):
            draw_timeline(timeline, facts, self._send)


def _height(is_shown: bool) -> float:
    """How high the window that is being drawn is, or the button in place of one that is not."""
    return float(imgui.GetWindowSize().y) if is_shown else _BUTTON_HEIGHT
