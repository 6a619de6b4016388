"""Draw recordings: one picture after the other, or many episodes side by side."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from fetch_hand_sim.films.recording import Recording
from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.scene import Scene, trail_of
from msgs_spec.arrays import Picture

_GAP = 2
# Colour and width of the edge around a tile whose episode has reached its goal.
_REACHED = np.array([40, 170, 70], dtype=np.uint8)
_EDGE = 3
# Tolerance of times, in seconds and in sheets.
_SAME_TIME = 1e-6


class Studio:
    """Draws recordings of any tasks in one size; each model is compiled once.

    The methods that draw raise ValueError if the frame or the camera does not exist, and
    RuntimeError without OpenGL.

    Args:
        width: Pixels.
        height: Pixels.
        camera: Name of a camera of the model; None for the usual view.
    """

    def __init__(self, width: int, height: int, camera: str | None = None) -> None:
        self.width, self.height = width, height
        self._camera = camera
        self._renderers: dict[str, SceneRenderer] = {}

    def pictures(self, recording: Recording) -> Iterator[Picture]:
        """Yield the picture (height, width, 3) of every frame."""
        for index in range(len(recording.frames)):
            yield self.picture(recording, index)

    def picture(self, recording: Recording, index: int) -> Picture:
        """Return the picture of one frame; negative indices count from the end."""
        frames, index = recording.frames, self._index(recording, index)
        renderer = self._renderer(recording.spec.name)
        return renderer.render(frames[index], trail_of(frames, index))

    def plain(self, recording: Recording, index: int) -> Picture:
        """Return the picture of one frame without trail, and with a goal of one colour."""
        frame = recording.frames[self._index(recording, index)]
        frame = replace(frame, is_success=False)
        return self._renderer(recording.spec.name).render(frame, [])

    def framed(self, recording: Recording, index: int) -> Picture:
        """Return the picture of one frame, with a green edge if the goal is reached."""
        picture = self.picture(recording, index)
        return with_edge(picture) if recording.frames[index].is_success else picture

    def close(self) -> None:
        """Free OpenGL."""
        for renderer in self._renderers.values():
            renderer.close()
        self._renderers.clear()

    def _index(self, recording: Recording, index: int) -> int:
        count = len(recording.frames)
        if not -count <= index < count:
            raise ValueError(f'{recording.title}: frame {index}; allowed: {-count} ... {count - 1}')
        return index % count

    def _renderer(self, task: str) -> SceneRenderer:
        if task not in self._renderers:
            self._renderers[task] = SceneRenderer(
                Scene(task), self.width, self.height, self._camera
            )
        return self._renderers[task]


def sheet_size(count: int, columns: int, width: int, height: int) -> tuple[int, int]:
    """Return width and height, pixels, of `count` pictures of one size side by side."""
    rows = -(-count // columns)
    return columns * (width + _GAP) - _GAP, rows * (height + _GAP) - _GAP


def tile(pictures: Sequence[Picture], columns: int) -> Picture:
    """Put pictures of one size side by side, row by row; empty places are white."""
    height, width = pictures[0].shape[:2]
    total_width, total_height = sheet_size(len(pictures), columns, width, height)
    sheet = np.full((total_height, total_width, 3), 255, dtype=np.uint8)
    for number, picture in enumerate(pictures):
        top, left = (number // columns) * (height + _GAP), (number % columns) * (width + _GAP)
        sheet[top : top + height, left : left + width] = picture
    return sheet


def grid(
    studio: Studio, recordings: Sequence[Recording], columns: int, hz: float
) -> Iterator[Picture]:
    """Yield sheets of all recordings at the same time; finished episodes show their last frame.

    Args:
        studio: Draws the tiles.
        recordings: Of any rates.
        columns: Tiles in a row.
        hz: Sheets per simulated second.
    """
    shown = [-1] * len(recordings)
    pictures: list[Picture] = [np.zeros(0, np.uint8)] * len(recordings)
    for count in range(sheets(recordings, hz)):
        for number, recording in enumerate(recordings):
            at = count / hz + _SAME_TIME
            index = int(np.searchsorted(recording.times, at, side='right')) - 1
            if index != shown[number]:
                shown[number], pictures[number] = index, studio.framed(recording, index)
        yield tile(pictures, columns)


def sheets(recordings: Sequence[Recording], hz: float) -> int:
    """Return the number of sheets that `grid` yields, to the end of the longest recording."""
    longest = max(float(recording.times[-1]) for recording in recordings)
    return 1 + math.ceil(longest * hz - _SAME_TIME)


def with_edge(picture: Picture) -> Picture:
    """Return a copy of the picture with a green edge."""
    framed = picture.copy()
    for edge in (np.s_[:_EDGE], np.s_[-_EDGE:], np.s_[:, :_EDGE], np.s_[:, -_EDGE:]):
        framed[edge] = _REACHED
    return framed
