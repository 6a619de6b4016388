"""Read episode files as frames, and draw one episode, or many side by side."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from fetch_hand_sim.episode_log import Episode, EpisodeReadError
from fetch_hand_sim.episode_log.arrays import EpisodeArrays, arrays_of, stamped_vectors
from fetch_hand_sim.episode_log.files import expand_episodes, holds_no_episode, read_each
from fetch_hand_sim.episode_log.reader import one_line_errors, read_episode
from fetch_hand_sim.simulation.rendering import SceneRenderer
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame, Scene, trail_of
from msgs_spec.arrays import Array, Picture
from msgs_spec.tasks import TaskSpec


@dataclass(frozen=True, slots=True)
class Recording:
    """An episode of N steps as N + 1 frames; `times` (N + 1,) are simulated s since the reset."""

    arrays: EpisodeArrays
    frames: list[Frame]
    times: Array
    title: str

    @property
    def spec(self) -> TaskSpec:
        """The task of the episode."""
        return self.arrays.spec

    @property
    def metric(self) -> GoalMetric:
        """The goal metric of the task, with the episode's success rule and sparse rewards."""
        return GoalMetric(self.spec, success_rule=self.arrays.record.success_rule)


def load_recording(path: Path) -> Recording:
    """Read a bag directory or MCAP file as frames; EpisodeReadError if it is no valid episode."""
    file = read_episode(path)
    return _recording(file, arrays_of(file))


def recording_of(arrays: EpisodeArrays) -> Recording:
    """Return a loaded episode as frames; joint and object positions come from its file."""
    return _recording(read_episode(arrays.path), arrays)


def _recording(file: Episode, arrays: EpisodeArrays) -> Recording:
    task, stamps, poses = arrays.record.task, arrays.stamps, None
    with one_line_errors(file.path):
        joints = stamped_vectors(file, task, 'joint_states', stamps)[:, : len(task.robot.joints)]
        if task.has_object:
            poses = stamped_vectors(file, task, 'object_pose', stamps)
    achieved, desired = arrays.observations['achieved_goal'], arrays.goals
    frames = [
        Frame(
            joint_position=joints[tick],
            desired_goal=desired[tick],
            achieved_goal=achieved[tick],
            object_pose=None if poses is None else poses[tick],
            is_success=bool(arrays.success[tick]),
        )
        for tick in range(len(stamps))
    ]
    times = (stamps - stamps[0]) * 1e-9
    return Recording(arrays, frames, times, arrays.path.stem.removesuffix('_0'))


def load_recordings(
    path: Path, count: int, on_skip: Callable[[EpisodeReadError], None] | None = None
) -> list[Recording]:
    """Read up to `count` readable episodes of a file or folder, in the order of their names.

    Args:
        on_skip: Called at the end with the error of each skipped episode; None raises the first.

    Raises:
        EpisodeReadError: If no episode is readable; `on_skip` is not called then.
    """
    skipped: list[EpisodeReadError] = []
    each = read_each(find_playable(path), load_recording, on_skip and skipped.append)
    recordings = list(islice(each, count))
    if not recordings:
        raise none_readable(skipped)
    if on_skip is not None:
        for reason in skipped:
            on_skip(reason)
    return recordings


def none_readable(errors: Sequence[EpisodeReadError]) -> EpisodeReadError:
    """Return the only one of `errors`, or an error with their number and the first message."""
    first, *others = errors
    if not others:
        return first
    return EpisodeReadError(f'none of {len(errors)} episodes can be read; the first: {first}')


def find_playable(path: Path) -> list[Path]:
    """Return `path`, or the sorted episodes in this folder; EpisodeReadError if it has none."""
    paths = expand_episodes(path)
    if not paths:
        raise holds_no_episode(path)
    return paths


_GAP = 2
# Colour and width of the edge around a tile whose episode has reached its goal.
_REACHED = np.array([40, 170, 70], dtype=np.uint8)
_EDGE = 3
# Tolerance of times, in seconds and in sheets.
_SAME_TIME = 1e-6


class Studio:
    """Draws recordings of any tasks as pictures of `width` x `height` pixels.

    `camera` is the name of a camera of the models; None is the default view of each task. Methods
    that draw raise ValueError if the frame or the camera does not exist, and RuntimeError without
    OpenGL.
    """

    def __init__(self, width: int, height: int, camera: str | None = None) -> None:
        self.width, self.height = width, height
        self._camera = camera
        self._renderers: dict[str, SceneRenderer] = {}

    def pictures(self, recording: Recording) -> Iterator[Picture]:
        """Yield the result of `picture` for every frame, in order."""
        for index in range(len(recording.frames)):
            yield self.picture(recording, index)

    def picture(self, recording: Recording, index: int) -> Picture:
        """Return the picture of a frame with goal and trail; -1 is the last frame."""
        frames, index = recording.frames, self._index(recording, index)
        renderer = self._renderer(recording.spec.name)
        return renderer.render(frames[index], trail_of(frames, index))

    def plain(self, recording: Recording, index: int) -> Picture:
        """Return the picture of a frame for data sets, which shows neither trail nor success."""
        frame = recording.frames[self._index(recording, index)]
        frame = replace(frame, is_success=False)
        return self._renderer(recording.spec.name).render(frame, [])

    def framed(self, recording: Recording, index: int) -> Picture:
        """Return the result of `picture`, with a green edge if this frame reaches the goal."""
        picture = self.picture(recording, index)
        return with_edge(picture) if recording.frames[index].is_success else picture

    def close(self) -> None:
        """Free all OpenGL contexts."""
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
    """Return width and height of the sheet that `tile` makes of `count` pictures, all in pixels."""
    rows = -(-count // columns)
    return columns * (width + _GAP) - _GAP, rows * (height + _GAP) - _GAP


def tile(pictures: Sequence[Picture], columns: int) -> Picture:
    """Join one or more pictures of equal size to a sheet, row by row; gaps are white."""
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
    """Yield `hz` sheets per simulated second until the longest recording ends.

    A sheet shows all recordings at the same time after their resets. A recording that has ended
    shows its last frame. A green edge marks a reached goal.
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
    """Return the number of sheets that `grid` yields."""
    longest = max(float(recording.times[-1]) for recording in recordings)
    return 1 + math.ceil(longest * hz - _SAME_TIME)


def with_edge(picture: Picture) -> Picture:
    """Return a copy of the picture whose outer pixels are a green edge."""
    framed = picture.copy()
    for edge in (np.s_[:_EDGE], np.s_[-_EDGE:], np.s_[:, :_EDGE], np.s_[:, -_EDGE:]):
        framed[edge] = _REACHED
    return framed
