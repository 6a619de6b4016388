"""Write films and pictures; the file suffix selects the format."""

from __future__ import annotations

import math
import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from io import BytesIO
from itertools import chain
from pathlib import Path
from typing import IO

import numpy as np
from PIL import Image, ImageSequence, TiffImagePlugin

from msgs_spec.arrays import Picture

MOVING = ('.mp4', '.gif', '.webp')
STILL = ('.png', '.jpg')
# Limit of the uncompressed pixels of one picture: 0.8 GB.
_MOST_PIXELS = 2**28
# Largest side that each format can store, pixels.
_LARGEST_SIDE = {'.mp4': 16384, '.gif': 65535, '.webp': 16383, '.jpg': 65500}
# Time unit of each format, milliseconds.
_UNITS = {'.gif': 10, '.webp': 1}
# Browsers replace shorter times by 100 ms.
_SHORTEST_MS = 20
# More colours make a GIF several times as large.
_GIF_COLORS = 128
_PALETTE_SAMPLES = 8


class _Pages(TiffImagePlugin.AppendingTiffWriter):
    """Appends pages to a TIFF; starts at the last page, where Pillow walks over all pages again."""

    _last_link: int | None = None

    def skipIFDs(self) -> None:
        """Go to the link at the end of the last page, which the next page fills in."""
        if self._last_link is not None:
            self.f.seek(self._last_link)
        super().skipIFDs()
        self._last_link = self.whereToWriteNewIFDOffset


class Roll:
    """A list of pictures (height, width, 3) of one size, uint8, losslessly compressed in memory."""

    def __init__(self) -> None:
        self._file = BytesIO()
        self._writer = _Pages(self._file, new=True)
        self._count = 0

    def __len__(self) -> int:
        return self._count

    def add(self, picture: Picture) -> None:
        """Append one picture."""
        image = Image.fromarray(picture)
        image.save(self._writer, format='TIFF', compression='tiff_adobe_deflate')
        self._writer.newFrame()
        self._count += 1

    def __iter__(self) -> Iterator[Picture]:
        """Yield the pictures as read-only arrays."""
        return map(np.asarray, ImageSequence.Iterator(self.open()))

    def open(self) -> Image.Image:
        """Return a Pillow image whose frames are the pictures; each is decoded when needed."""
        return Image.open(self._file)


def check_kind(path: Path) -> None:
    """Raise ValueError for an unknown suffix, a directory, a missing folder or a missing ffmpeg."""
    kind = path.suffix.lower()
    if kind not in (*MOVING, *STILL):
        raise ValueError(
            f'{path.name} has no known suffix; allowed: {", ".join((*MOVING, *STILL))}'
        )
    if path.is_dir():
        raise ValueError(f'{path} is a directory; a file is allowed')
    if not path.absolute().parent.is_dir():
        raise ValueError(f'{path}: {path.absolute().parent} is no directory')
    if kind == '.mp4':
        find_ffmpeg()


def check_size(path: Path, width: int, height: int) -> None:
    """Raise ValueError if a side is too long for the file format or the area over 2^28 pixels."""
    kind = path.suffix.lower()
    largest = _LARGEST_SIDE.get(kind)
    if largest is not None and max(width, height) > largest:
        raise ValueError(f'{width}x{height} pixels; allowed: {largest} a side of a {kind} file')
    if width * height > _MOST_PIXELS:
        raise ValueError(f'{width}x{height} pixels; allowed: {_MOST_PIXELS} in all')


def write_film(
    path: Path, pictures: Iterable[Picture], fps: float, keyframe_every: int = 0
) -> None:
    """Write pictures (height, width, 3) of one size as a film; the file appears when complete.

    Args:
        fps: Pictures per second. GIF and WebP show at most 50. Above that, only every n-th picture
            is written, so that the duration stays the same.
        keyframe_every: Pictures between two keyframes of an .mp4, for programs that seek in it;
            0 leaves the choice to the encoder.

    Raises:
        ValueError: If ffmpeg is missing.
        OSError: If ffmpeg fails or the file cannot be written.
    """
    with _appearing(path) as hidden:
        if path.suffix.lower() == '.mp4':
            _write_mp4(hidden, pictures, fps, keyframe_every)
        else:
            write_animation(hidden, pictures, fps, path.suffix.lower())


def write_picture(path: Path, picture: Picture) -> None:
    """Write one picture (height, width, 3) as .png or .jpg; the file appears when complete."""
    with _appearing(path) as hidden:
        Image.fromarray(picture).save(hidden, quality=85, optimize=True)


def write_animation(
    target: Path | IO[bytes], pictures: Iterable[Picture], fps: float, kind: str
) -> None:
    """Write pictures (height, width, 3) as `kind`, `.gif` or `.webp`; `fps` as in `write_film`."""
    every, roll, count = math.ceil(fps * _SHORTEST_MS / 1000.0), Roll(), 0
    for count, picture in enumerate(pictures, start=1):
        if (count - 1) % every == 0:
            roll.add(picture)
    begins = np.append(np.arange(0, count, every), count) * (1000.0 / fps)
    # Differences of rounded times, so that rounding errors do not add up.
    lengths = np.diff(np.rint(begins / _UNITS[kind]).astype(int) * _UNITS[kind])
    timing = {'duration': [max(_SHORTEST_MS, each) for each in lengths.tolist()], 'loop': 0}
    if kind == '.gif':
        images = _with_one_palette(roll)
        next(images).save(
            target, format='GIF', save_all=True, append_images=images, optimize=True, **timing
        )
    else:
        roll.open().save(target, format='WEBP', save_all=True, quality=72, method=4, **timing)


def _with_one_palette(roll: Roll) -> Iterator[Image.Image]:
    """Yield the pictures as palette images with one common palette; separate palettes flicker."""
    some = range(0, len(roll), max(1, len(roll) // _PALETTE_SAMPLES))
    samples = [picture for number, picture in enumerate(roll) if number in some]
    palette = Image.fromarray(np.concatenate(samples)).quantize(_GIF_COLORS)
    for picture in roll:
        yield Image.fromarray(picture).quantize(palette=palette)


def _write_mp4(path: Path, pictures: Iterable[Picture], fps: float, keyframe_every: int) -> None:
    iterator = iter(pictures)
    first = next(iterator)
    height, width = first.shape[:2]
    # A ratio: six digits of 500/11 are a picture off after some hours.
    rate = Fraction(fps).limit_denominator(1000)
    command = [find_ffmpeg(), '-y', '-loglevel', 'error', '-f', 'rawvideo', '-pix_fmt', 'rgb24']
    command += ['-s', f'{width}x{height}', '-r', f'{rate.numerator}/{rate.denominator}']
    command += ['-i', '-', '-an']
    # H.264 in 4:2:0, which every player shows, needs even sides.
    command += ['-vf', 'pad=ceil(iw/2)*2:ceil(ih/2)*2', '-c:v', 'libx264', '-crf', '20']
    if keyframe_every:
        command += ['-g', str(keyframe_every), '-bf', '0']
    command += ['-pix_fmt', 'yuv420p', '-movflags', '+faststart', '-f', 'mp4', str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        assert process.stdin is not None and process.stderr is not None
        try:
            for picture in chain([first], iterator):
                process.stdin.write(np.ascontiguousarray(picture).tobytes())
            process.stdin.close()
        except BrokenPipeError:
            # Buffered data would break the pipe again at the end of the block.
            with suppress(BrokenPipeError):
                process.stdin.close()
        complaint = process.stderr.read().decode(errors='replace')
    if process.returncode:
        raise OSError(f'ffmpeg: {complaint or process.returncode}')


def find_ffmpeg() -> str:
    """Return the path of ffmpeg; ValueError, which names what to install, if it is missing."""
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        found = shutil.which('ffmpeg')
    if found is None:
        raise ValueError(
            ".mp4 needs ffmpeg: pip install 'fetch_hand_sim[film]'; a .gif or .webp does not"
        )
    return found


@contextmanager
def _appearing(path: Path) -> Iterator[Path]:
    """Yield the path of a hidden file, which is renamed to `path` on success and else removed."""
    # Follow a link, so that it stays a link.
    target = path.resolve()
    # The process id keeps two processes apart that write the same film.
    hidden = target.with_name(f'.{target.stem}.{os.getpid()}.active{path.suffix.lower()}')
    try:
        yield hidden
        os.replace(hidden, target)
    except OSError as error:
        if error.strerror is None:
            raise
        raise OSError(f'{path}: {error.strerror}') from error
    finally:
        # A read-only disk also refuses to remove a file that does not exist.
        with suppress(OSError):
            hidden.unlink()
