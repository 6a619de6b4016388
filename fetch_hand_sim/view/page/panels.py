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
from fetch_hand_sim.view.picture import Facts, Picture, Timeline
from msgs_spec.tasks import task_spec

_TIMELINE_HEIGHT = 74.0
_LEAST_LIST = 100.0


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
        self._robot_height = 0.0

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
            self._robot_height = imgui.GetWindowSize().y if is_shown else 3.0 * MARGIN
        right = size.x - WIDTH - MARGIN
        with self._windows.column('Curves###curves', right, MARGIN) as is_shown:
            if is_shown:
                draw_plots(spec, picture.graphs, WIDTH)
        if picture.timeline is not None:
            self._draw_file(picture.timeline, picture.facts)

    def _draw_file(self, timeline: Timeline, facts: Facts) -> None:
        size = imgui.GetIO().DisplaySize
        top = size.y - _TIMELINE_HEIGHT - MARGIN
        if len(self._episode_list) > 1:
            y = self._robot_height + 2.0 * MARGIN
            height = max(top - y - MARGIN, _LEAST_LIST)
            with self._windows.column('Episodes', MARGIN, y, height) as is_shown:
                if is_shown:
                    self._episode_list.draw(timeline.number)
        width = size.x - 2.0 * MARGIN
        with untitled_window('timeline', MARGIN, top, width, _TIMELINE_HEIGHT):
            draw_timeline(timeline, facts, self._send)
