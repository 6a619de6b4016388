"""Films as GIF and WebP, whose pictures are not all in memory at once."""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import IO, Any

import numpy as np
from PIL import Image

from msgs_spec.arrays import Picture

# Quality of WebP, and colours of GIF: all of them would make files several times as large.
_QUALITY = 72
_COLORS = 128
_SAMPLES = 8
# Milliseconds that a GIF and a WebP count in.
_UNITS = {'.gif': 10, '.webp': 1}
# The shortest a picture is shown, in either format: browsers make 100 ms of less.
_SHORTEST_MS = 20
# Fast, and a tenth is left of pictures of a robot.
_COMPRESSION = 1


class Roll:
    """Pictures (height, width, 3) of one size, packed."""

    def __init__(self) -> None:
        self._packed: list[bytes] = []
        self._shape: tuple[int, ...] = ()

    def __len__(self) -> int:
        return len(self._packed)

    def add(self, picture: Picture) -> None:
        """Appends one."""
        self._shape = picture.shape
        self._packed.append(zlib.compress(picture.tobytes(), _COMPRESSION))

    def picture(self, number: int) -> Picture:
        """Returns one, read-only."""
        data = zlib.decompress(self._packed[number])
        return np.frombuffer(data, dtype=np.uint8).reshape(self._shape)


class _Film(Image.Image):
    """An image of several frames, as Pillow's own of files are: each is made when it is sought.

    Args:
        count: How many frames.
        frame: Makes one.
    """

    def __init__(self, count: int, frame: Callable[[int], Image.Image]) -> None:
        super().__init__()
        self.n_frames = count
        self._make, self._at = frame, -1
        self.seek(0)

    def seek(self, frame: int) -> None:
        """Becomes another frame; raises EOFError behind the last."""
        if frame >= self.n_frames:
            raise EOFError
        if frame == self._at:
            return
        made, self._at = self._make(frame), frame
        self.im, self.palette, self._mode, self._size = made.im, made.palette, made.mode, made.size

    def tell(self) -> int:
        """The frame that it is."""
        return self._at


def write_animation(
    target: Path | IO[bytes], pictures: Iterable[Picture], fps: float, kind: str
) -> None:
    """Writes pictures (height, width, 3) of one size.

    Args:
        target: Where to.
        pictures: Drawn as they come.
        fps: Pictures per second; of more than 50 every n-th is taken.
        kind: `.gif` or `.webp`.
    """
    every, roll, count = _kept_every(fps), Roll(), 0
    for count, picture in enumerate(pictures, start=1):
        if (count - 1) % every == 0:
            roll.add(picture)
    options: dict[str, Any] = {'quality': _QUALITY, 'method': 4}
    film = _Film(len(roll), lambda number: Image.fromarray(roll.picture(number)))
    if kind == '.gif':
        palette = _palette(roll)
        film = _Film(
            len(roll),
            lambda number: Image.fromarray(roll.picture(number)).quantize(palette=palette),
        )
        options = {'optimize': True}
    durations = _durations(count, fps, _UNITS[kind])
    film.save(target, format=kind[1:], save_all=True, duration=durations, loop=0, **options)


def _palette(roll: Roll) -> Image.Image:
    """One palette for all, or colours flicker; made of some, because goals change their colour."""
    some = range(0, len(roll), max(1, len(roll) // _SAMPLES))
    samples = Image.fromarray(np.concatenate([roll.picture(number) for number in some]))
    return samples.quantize(_COLORS)


def _kept_every(fps: float) -> int:
    """One of how many pictures can be shown."""
    return math.ceil(fps * _SHORTEST_MS / 1000.0)


def _durations(count: int, fps: float, unit: int) -> list[int]:
    """Milliseconds of the pictures kept of `count`, in units; what is rounded never adds up."""
    begins = np.append(np.arange(0, count, _kept_every(fps)), count) * (1000.0 / fps)
    lengths = np.diff(np.rint(begins / unit).astype(int) * unit)
    return [max(_SHORTEST_MS, length) for length in lengths.tolist()]
