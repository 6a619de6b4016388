"""The episodes of a folder, to choose from."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from mujoco.studio.dear_imgui import dear_imgui as imgui

from fetch_hand_sim.episode_log import EpisodeReadError
from fetch_hand_sim.episode_log.summary import read_summary
from fetch_hand_sim.view.page.windows import Send
from fetch_hand_sim.view.requests import OpenEpisode


def describe(path: Path) -> str:
    """Returns name and outcome of an episode, about 1 ms."""
    name = path.name.removesuffix('.mcap')
    try:
        outcome = read_summary(path).outcome
    except (EpisodeReadError, ValueError):
        return f'{name}  unreadable'
    if not outcome.is_complete:
        return f'{name}  interrupted'
    return f'{name}  {"reached" if outcome.is_success else "missed"}'


class EpisodeList:
    """A list that can be clicked; what is not seen of it is not read.

    Args:
        paths: Episodes.
        send: Gets what people choose.
    """

    def __init__(self, paths: tuple[Path, ...], send: Send) -> None:
        self._paths = paths
        self._send = send
        self._describe = cache(describe)
        # Played last time, and clicked since.
        self._played = self._clicked = -1

    def __len__(self) -> int:
        """How many there are."""
        return len(self._paths)

    def draw(self, number: int) -> None:
        """Draws the part of the list that is seen.

        Args:
            number: Which one is being played.
        """
        if number != self._played and number != self._clicked:
            # What was changed to elsewhere on the page comes into view.
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
