"""Write logged episodes as Parquet, Minari or LeRobot datasets, one for each task.

Exit code 0: all episodes are in the datasets; 1: an episode was skipped (stderr names it) or a
dataset could not be written; 2: bad usage, or no readable episode.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.commands.options import add_filter_options, is_wanted, picture_size
from fetch_hand_sim.datasets import minari
from fetch_hand_sim.datasets.writing import ByTask, why_apart
from fetch_hand_sim.episode_log import (
    EpisodeArrays,
    EpisodeReadError,
    expand_episodes,
    read_episode,
)
from fetch_hand_sim.episode_log.arrays import arrays_of
from fetch_hand_sim.episode_log.files import holds_no_episode
from msgs_spec.text import counted
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    EXIT_USAGE,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    progress,
    require_extra,
    run_command,
    say,
    usage_errors,
)

_NAME = 'fetch_hand_sim episodes export'
_TITLES = {'parquet': 'Parquet', 'minari': 'Minari', 'lerobot': 'LeRobot'}
_NEEDED = {'parquet': ('pyarrow',), 'minari': ('pyarrow', 'minari'), 'lerobot': ('pyarrow',)}


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('path', type=Path, help='an episode, or a folder of episodes')
    parser.add_argument('--to', choices=tuple(_TITLES), required=True)
    parser.add_argument('--output', type=Path, required=True, help='folder for the datasets')
    add_filter_options(parser)
    parser.add_argument('--name', help='name of a Minari dataset; default: logged-v0')
    parser.add_argument(
        '--pictures',
        type=picture_size,
        metavar='WxH',
        help='size of films in a LeRobot dataset; default: no films',
    )
    parser.add_argument('--camera', help='camera of the model for --pictures; default: a good view')
    options = parser.parse_args(arguments)
    if options.name is not None and options.to != 'minari':
        parser.error(f'--name is for --to minari, not {options.to}')
    if options.pictures and options.to != 'lerobot':
        parser.error(f'--pictures is for --to lerobot, not {options.to}')
    if options.camera and not options.pictures:
        parser.error('--camera needs --pictures')
    if options.pictures and any(side % 2 for side in options.pictures):
        parser.error('--pictures: both sides must be even')
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = _parse(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    _require_packages(options)
    name = minari.dataset_name('logged-v0' if options.name is None else options.name)
    skipped: list[EpisodeReadError] = []
    by_task: dict[str, list[EpisodeArrays]] = {}
    filtered = 0
    with usage_errors(EpisodeReadError):
        paths = expand_episodes(options.path)
        with progress('episodes', len(paths)) as advance:
            for path in paths:
                try:
                    filtered += not _add(path, by_task, options)
                except EpisodeReadError as error:
                    skipped.append(error)
                advance(1)
    for reason in skipped:
        complain(_NAME, f'skipped {reason}')
    if not by_task and skipped:
        return EXIT_USAGE
    if not by_task:
        raise UsageError(_why_none(options.path, filtered))
    for task, written in _export(options, by_task, name).items():
        say(f'{_counted(by_task[task])} of {task}: {written}')
    return EXIT_FAILURE if skipped else EXIT_SUCCESS


def _require_packages(options: argparse.Namespace) -> None:
    """Raise UsageError, which names what to install, if the export needs a missing package."""
    require_extra('data', *_NEEDED[options.to])
    if options.pictures is not None:
        from fetch_hand_sim.films.film import find_ffmpeg

        with usage_errors():
            find_ffmpeg()


def _why_none(path: Path, filtered: int) -> str:
    if filtered:
        return f'the filters reject all {filtered} episodes in {path}'
    return str(holds_no_episode(path))


def _counted(episodes: Sequence[EpisodeArrays]) -> str:
    """Return a text with the number of episodes and how many of them were interrupted."""
    interrupted = sum(not episode.is_complete for episode in episodes)
    told = f', {interrupted} of them interrupted,' if interrupted else ''
    return f'{counted(len(episodes), "episode")}{told}'


def _add(path: Path, by_task: dict[str, list[EpisodeArrays]], options: argparse.Namespace) -> bool:
    """Load an episode into `by_task`; return False if the filter options reject it.

    EpisodeReadError if it is unreadable or cannot share a dataset with the task's other episodes.
    """
    file = read_episode(path)
    if not is_wanted(options, file.metadata.get('task'), file):
        return False
    episode = arrays_of(file)
    if why := _why_left_out(episode, by_task.get(episode.spec.name, []), options.to):
        raise EpisodeReadError(f'{path}: {why}')
    by_task.setdefault(episode.spec.name, []).append(episode)
    return True


def _why_left_out(episode: EpisodeArrays, others: Sequence[EpisodeArrays], to: str) -> str:
    """Return why an episode cannot share a dataset of format `to` with `others`; '' if it can."""
    if to == 'parquet':
        return ''
    if len(episode) == 0:
        return f'no steps; {_TITLES[to]} needs at least one'
    return why_apart(episode, others[0]) if others else ''


def _export(options: argparse.Namespace, by_task: ByTask, name: str) -> dict[str, str]:
    """Write a dataset per task and return its location, text, by task; only Minari uses `name`."""
    if options.to == 'parquet':
        # pyarrow is an extra, and slow to import.
        from fetch_hand_sim.datasets.parquet import export_parquet

        files = export_parquet(by_task, options.output)
        return {task: ', '.join(map(str, paths)) for task, paths in files.items()}
    if options.to == 'lerobot':
        found = _export_lerobot(options, by_task)
        return {task: f'LeRobot dataset {path}' for task, path in found.items()}
    ids = minari.export_minari(by_task, options.output, name)
    return {task: f'Minari dataset {each} in {options.output}' for task, each in ids.items()}


def _export_lerobot(options: argparse.Namespace, by_task: ByTask) -> dict[str, Path]:
    # Only films need MuJoCo.
    from fetch_hand_sim.datasets.lerobot import Camera, export_lerobot

    camera = None
    if options.pictures is not None:
        width, height = options.pictures
        camera = Camera(width, height, options.camera)
    try:
        return export_lerobot(by_task, options.output, camera)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except RuntimeError as error:
        raise CommandError(str(error)) from None
