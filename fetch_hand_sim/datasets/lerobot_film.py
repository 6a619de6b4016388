"""The films of a LeRobot dataset: every frame of its episodes, drawn from the log."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.datasets.lerobot_columns import QUANTILES, quantile_name
from fetch_hand_sim.episode_log import EpisodeArrays
from fetch_hand_sim.films.film import write_film
from fetch_hand_sim.films.recording import recording_of
from fetch_hand_sim.films.studio import Studio
from msgs_spec.arrays import Picture

_LEVELS = 256
# Pictures from one keyframe to the next, as lerobot encodes films.
_KEYFRAME_EVERY = 2

Histogram = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera of the films of a dataset.

    Attributes:
        width: Width of pictures, pixels; even, because of H.264.
        height: Height, likewise.
        name: Name of a camera of the model; None for the usual view.
    """

    width: int
    height: int
    name: str | None = None

    @property
    def key(self) -> str:
        """The name of the column."""
        return f'observation.images.{self.name or "scene"}'

    def feature(self, rate: float) -> dict[str, Any]:
        """Return the column as in `meta/info.json`, for `rate` pictures per second."""
        return {
            'dtype': 'video',
            'shape': [self.height, self.width, 3],
            'names': ['height', 'width', 'channels'],
            'info': {
                'video.height': self.height,
                'video.width': self.width,
                'video.codec': 'h264',
                'video.pix_fmt': 'yuv420p',
                'video.is_depth_map': False,
                'video.fps': rate,
                'video.channels': 3,
                'has_audio': False,
            },
        }


def write_episodes(
    path: Path, episodes: Sequence[EpisodeArrays], camera: Camera, rate: float
) -> list[Histogram]:
    """Write a film of all frames of episodes except the last of each, which has no action.

    Returns:
        How often each level of each channel was drawn, (3, 256) for each episode.

    Raises:
        ValueError: If the model has no such camera, an episode cannot be read, or ffmpeg is
            missing.
        RuntimeError: If OpenGL is missing.
        OSError: If the film cannot be written.
    """
    studio = Studio(camera.width, camera.height, camera.name)
    histograms = [np.zeros((3, _LEVELS), dtype=np.int64) for _ in episodes]
    try:
        pictures = _counted(studio, episodes, histograms)
        write_film(path, pictures, rate, keyframe_every=_KEYFRAME_EVERY)
    finally:
        studio.close()
    return histograms


def _counted(
    studio: Studio, episodes: Sequence[EpisodeArrays], histograms: Sequence[Histogram]
) -> Iterator[Picture]:
    for episode, histogram in zip(episodes, histograms, strict=True):
        recording = recording_of(episode)
        for index in range(len(recording.frames) - 1):
            picture = studio.plain(recording, index)
            for channel, row in enumerate(histogram):
                row += np.bincount(picture[..., channel].ravel(), minlength=_LEVELS)
            yield picture


def color_statistics(histogram: Histogram, pixels: int) -> dict[str, Any]:
    """Return the statistics of pictures for normalisation: levels in [0, 1], each (3, 1, 1).

    Args:
        histogram: (3, 256) how often each level was drawn.
        pixels: Number of pixels of a picture.
    """
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    total = int(histogram[0].sum())
    share = histogram / total
    mean = share @ levels
    drawn, below = histogram > 0, np.cumsum(histogram, axis=1)
    found = {
        'min': levels[drawn.argmax(axis=1)],
        'max': levels[_LEVELS - 1 - drawn[:, ::-1].argmax(axis=1)],
        'mean': mean,
        'std': np.sqrt(np.maximum(share @ levels**2 - mean**2, 0.0)),
        **{
            quantile_name(each): levels[(below >= each * total).argmax(axis=1)]
            for each in QUANTILES
        },
    }
    values = {name: each.reshape(3, 1, 1).tolist() for name, each in found.items()}
    return {**values, 'count': [total // pixels]}
