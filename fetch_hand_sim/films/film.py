"""Writes films and pictures; the ending of the file says what kind."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from fractions import Fraction
from itertools import chain
from pathlib import Path

import numpy as np

from msgs_spec.arrays import Picture
from node_runtime.command_line import CommandError, UsageError

MOVING = ('.mp4', '.gif', '.webp')
STILL = ('.png', '.jpg')
# All pixels of a picture that are held at a time, at most: 0.8 GB.
_MOST_PIXELS = 2**28
# Pixels of a side, at most.
_LARGEST_SIDE = {'.mp4': 16384, '.gif': 65535, '.webp': 16383, '.jpg': 65500}


def check_kind(path: Path) -> None:
    """Checks that a file can be written, before anything is drawn.

    Raises:
        UsageError: If its ending is not known, its folder not there, or what it needs missing.
    """
    kind = path.suffix.lower()
    if kind not in (*MOVING, *STILL):
        raise UsageError(f'--out {path}; allowed: {", ".join((*MOVING, *STILL))}')
    if path.is_dir():
        raise UsageError(f'--out {path} is a directory; a file is allowed')
    if not path.absolute().parent.is_dir():
        raise UsageError(f'--out {path}: {path.absolute().parent} is no directory')
    if kind == '.mp4':
        _ffmpeg()


def check_size(path: Path, width: int, height: int) -> None:
    """Checks that pictures of a size can be written, before they are drawn.

    Raises:
        UsageError: If the kind of file takes none as large.
    """
    kind = path.suffix.lower()
    largest = _LARGEST_SIDE.get(kind)
    if largest is not None and max(width, height) > largest:
        raise UsageError(f'{width}x{height} pixels; allowed: {largest} a side of a {kind} file')
    if width * height > _MOST_PIXELS:
        raise UsageError(f'{width}x{height} pixels; allowed: {_MOST_PIXELS} in all')


def write_film(
    path: Path, pictures: Iterable[Picture], fps: float, keyframe_every: int = 0
) -> None:
    """Writes pictures (height, width, 3) of one size; the file appears when it is complete.

    Args:
        path: Ending in .mp4, .gif or .webp.
        pictures: Drawn as they are written.
        fps: Pictures per second. A GIF or WebP shows 50 at most: it takes every n-th picture where
            there are more, so that the film lasts as long.
        keyframe_every: Of an .mp4, how many pictures apart those are that need no other to be
            shown, for those who jump about in it; 0 for as the encoder likes.

    Raises:
        UsageError: If there is no ffmpeg.
        CommandError: If it fails, or the file cannot be written.
    """
    # Pillow is slow to import, and checks come before.
    from fetch_hand_sim.films.animation import write_animation

    with _appearing(path) as hidden:
        if path.suffix.lower() == '.mp4':
            _write_mp4(hidden, pictures, fps, keyframe_every)
        else:
            write_animation(hidden, pictures, fps, path.suffix.lower())


def write_picture(path: Path, picture: Picture) -> None:
    """Writes one picture (height, width, 3) as .png or .jpg; the file appears when it is complete.

    Raises:
        CommandError: If it cannot be written.
    """
    from PIL import Image

    with _appearing(path) as hidden:
        Image.fromarray(picture).save(hidden, quality=85, optimize=True)


def _write_mp4(path: Path, pictures: Iterable[Picture], fps: float, keyframe_every: int) -> None:
    iterator = iter(pictures)
    first = next(iterator)
    height, width = first.shape[:2]
    # As a ratio: in six digits 500/11 pictures a second are a picture off after some hours, and
    # who looks one up by its time wants it to the tenth of a millisecond.
    rate = Fraction(fps).limit_denominator(1000)
    command = [_ffmpeg(), '-y', '-loglevel', 'error', '-f', 'rawvideo', '-pix_fmt', 'rgb24']
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
            # What is still in the buffer would break the pipe again, at the end of the block.
            with suppress(BrokenPipeError):
                process.stdin.close()
        complaint = process.stderr.read().decode(errors='replace')
    if process.returncode:
        raise CommandError(f'ffmpeg: {complaint or process.returncode}')


def _ffmpeg() -> str:
    try:
        from imageio_ffmpeg import get_ffmpeg_exe

        return str(get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        found = shutil.which('ffmpeg')
    if found is None:
        raise UsageError("mp4 needs ffmpeg: pip install 'fetch_hand_sim[film]'; or write a .gif")
    return found


@contextmanager
def _appearing(path: Path) -> Iterator[Path]:
    """A hidden file beside the path that takes its name when all is written."""
    # A link stays one: what it leads to is written.
    target = path.resolve()
    # Named by process: of two that write one film at once the later one's stays, and it is whole.
    hidden = target.with_name(f'.{target.stem}.{os.getpid()}.active{path.suffix.lower()}')
    try:
        yield hidden
        os.replace(hidden, target)
    except OSError as error:
        raise CommandError(f'{path}: {error.strerror or error}') from error
    finally:
        # A disk that may only be read refuses to remove what is not there, too.
        with suppress(OSError):
            hidden.unlink()
