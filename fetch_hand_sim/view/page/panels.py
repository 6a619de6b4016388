"""All panels of the page and their layout."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.episode_log import EpisodeReadError, read_summary
from fetch_hand_sim.view.page.goal_panel import GoalPanel
from fetch_hand_sim.view.page.plots import draw_plots
from fetch_hand_sim.view.page.robot_panel import RobotPanel
from fetch_hand_sim.view.page.widgets import (
    MARGIN,
    WIDTH,
    Send,
    Windows,
    draw_pause,
    draw_speed,
    draw_step,
    say,
    untitled_window,
)
from fetch_hand_sim.view.picture import Facts, Graphs, Picture, Timeline
from fetch_hand_sim.view.requests import ChangeEpisode, OpenEpisode, Seek
from msgs_spec.tasks import TaskSpec, task_spec

# Pixels.
_TIMELINE_HEIGHT = 74.0
_LEAST_LIST = 100.0
_BUTTON_HEIGHT = 3.0 * MARGIN
# The narrowest page with two columns; an upright phone has less.
_TWO_COLUMNS = 2.0 * WIDTH + 3.0 * MARGIN


class Panels:
    """Draws all panels and stores the user's input.

    Args:
        send: Called with each request of the user.
        episodes: Episode files to choose from.

    Attributes:
        goal_panel: The panel that sets the goal.
    """

    def __init__(self, send: Send, episodes: tuple[Path, ...] = ()) -> None:
        self._send = send
        self._windows = Windows()
        self.goal_panel = GoalPanel(send)
        self._robot_panel = RobotPanel(send, self.goal_panel)
        self._episode_list = EpisodeList(episodes, send)
        # Upper edge of the next window in the left column.
        self._below = 0.0

    def draw(self, picture: Picture | None) -> None:
        """Draw all panels for one frame; without a picture, only the text `Waiting for a robot`."""
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
        """Draw the curves at the right edge, or below the robot panel on a narrow page."""
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
    """Return the height, pixels, of the current window, or of its button if it is folded."""
    return float(imgui.GetWindowSize().y) if is_shown else _BUTTON_HEIGHT


class EpisodeList:
    """A list of episode files; a click plays one. Only the files of visible rows are read."""

    def __init__(self, paths: tuple[Path, ...], send: Send) -> None:
        self._paths = paths
        self._send = send
        self._describe = cache(describe)
        self._played = self._clicked = -1

    def __len__(self) -> int:
        return len(self._paths)

    def draw(self, number: int) -> None:
        """Draw the visible rows; highlight and scroll to the played one, which is `number`."""
        if number != self._played and number != self._clicked:
            # Scroll to an episode that was chosen elsewhere on the page.
            height = imgui.GetTextLineHeightWithSpacing()
            imgui.SetScrollY(max(0.0, (number - 3) * height))
        self._played = number
        clipper = imgui.ListClipper()
        clipper.Begin(len(self._paths))
        while clipper.Step():
            for index in range(clipper.DisplayStart, clipper.DisplayEnd):
                label = f'{self._describe(self._paths[index])}##{index}'
                if imgui.Selectable(label, index == number):
                    self._clicked = index
                    self._send(OpenEpisode(index))


def describe(path: Path) -> str:
    """Return name and outcome (`reached`, `missed`, `interrupted`, `unreadable`) of an episode."""
    name = path.name.removesuffix('.mcap')
    try:
        outcome = read_summary(path).outcome
    except EpisodeReadError:
        return f'{name}  unreadable'
    if not outcome.is_complete:
        return f'{name}  interrupted'
    return f'{name}  {"reached" if outcome.is_success else "missed"}'


def draw_timeline(timeline: Timeline, facts: Facts, send: Send) -> None:
    """Draw the playback controls of a file, disabled if the page may only watch."""
    imgui.BeginDisabled(not facts.may_command)
    if imgui.Button('<< Episode'):
        send(ChangeEpisode(-1))
    imgui.SameLine()
    draw_step('< Step', -1, send)
    imgui.SameLine()
    draw_pause(facts.is_paused, 'Play', send)
    imgui.SameLine()
    draw_step('Step >', 1, send)
    imgui.SameLine()
    if imgui.Button('Episode >>'):
        send(ChangeEpisode(1))
    imgui.SameLine()
    draw_speed(facts.speed, send)
    imgui.SameLine()
    where = f'{timeline.time:.2f} s   {timeline.title} ({timeline.number + 1} of {timeline.count})'
    imgui.Text(where)
    imgui.SetNextItemWidth(-1.0)
    moved, index = imgui.SliderInt('##timeline', facts.tick, 0, facts.ticks, 'frame %d')
    if moved:
        send(Seek(index))
    imgui.EndDisabled()
