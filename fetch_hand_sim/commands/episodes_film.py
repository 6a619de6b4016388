"""Write a film or a picture of a logged episode, or of several side by side, without a display.

Unreadable episodes in a folder are skipped and named on stderr. Exit code 0: written; 1: drawing or
writing failed; 2: bad usage, or no readable episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from fetch_hand_sim.commands.options import picture_size, two_numbers
from msgs_spec.arrays import Picture
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    progress,
    run_command,
    say,
)

_NAME = 'fetch_hand_sim episodes film'
_SPEEDS = (0.01, 100.0)


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('path', type=Path, help='an episode; with --grid a folder of episodes')
    parser.add_argument(
        '--out', type=Path, required=True, help='film.mp4, .gif or .webp; picture.png or .jpg'
    )
    parser.add_argument(
        '--size',
        type=picture_size,
        default=(640, 480),
        metavar='WxH',
        help='pixels; default: 640x480',
    )
    parser.add_argument('--camera', help='camera of the model; default: a good view')
    parser.add_argument(
        '--grid', type=two_numbers(20), metavar='CxR', help='columns x rows of episodes: 4x4'
    )
    parser.add_argument('--frame', type=int, help='frame for a picture; default: -1, the last')
    parser.add_argument(
        '--speed', type=float, help='simulated seconds per second of a film; default: 1'
    )
    options = parser.parse_args(arguments)
    if options.speed is not None and not _SPEEDS[0] <= options.speed <= _SPEEDS[1]:
        parser.error(f'--speed {options.speed:g}; allowed: {_SPEEDS[0]:g} ... {_SPEEDS[1]:g}')
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = _parse(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    from fetch_hand_sim.films.film import STILL, check_kind

    try:
        check_kind(options.out)
        is_picture = options.out.suffix.lower() in STILL
        if is_picture and options.speed is not None:
            raise UsageError(
                f'--speed is for films (.mp4, .gif, .webp); {options.out} is a picture'
            )
        if not is_picture and options.frame is not None:
            raise UsageError(f'--frame is for pictures (.png, .jpg); {options.out} is a film')
        _render(options, is_picture)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except BrokenPipeError:
        # `run_command` returns 141 for a closed output.
        raise
    except (RuntimeError, OSError) as error:
        raise CommandError(str(error)) from None
    say(f'{options.out}: {options.out.stat().st_size / 1024:.0f} KiB')
    return EXIT_SUCCESS


def _render(options: argparse.Namespace, is_picture: bool) -> None:
    from fetch_hand_sim.films.film import check_size, write_film, write_picture
    from fetch_hand_sim.films.recording import (
        Recording,
        Studio,
        find_playable,
        grid,
        load_recordings,
        sheet_size,
        sheets,
        tile,
    )

    columns, rows = options.grid or (1, 1)
    recordings: list[Recording] = load_recordings(
        options.path, columns * rows, on_skip=lambda error: complain(_NAME, f'skipped {error}')
    )
    if options.grid is None and (found := len(find_playable(options.path))) > 1:
        say(f'{recordings[0].title} alone, of {found} episodes; --grid CxR takes several')
    width, height = options.size
    check_size(options.out, *sheet_size(len(recordings), columns, width, height))
    studio = Studio(width, height, options.camera)
    try:
        if is_picture:
            draw = Studio.framed if options.grid else Studio.picture
            index = -1 if options.frame is None else options.frame
            stills = [draw(studio, recording, index) for recording in recordings]
            write_picture(options.out, tile(stills, columns))
            return
        # At the fastest rate, no recording loses a frame.
        hz = max(recording.arrays.record.control_hz for recording in recordings)
        pictures: Iterator[Picture] = studio.pictures(recordings[0])
        count = len(recordings[0].frames)
        if options.grid:
            pictures, count = grid(studio, recordings, columns, hz), sheets(recordings, hz)
        with progress('pictures', count) as advance:
            write_film(options.out, _counted(pictures, advance), hz * (options.speed or 1.0))
    finally:
        studio.close()


def _counted(pictures: Iterator[Picture], advance: Callable[[int], None]) -> Iterator[Picture]:
    for picture in pictures:
        yield picture
        advance(1)
