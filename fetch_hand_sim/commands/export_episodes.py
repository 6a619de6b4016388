"""`export_episodes DIR --to parquet|minari|lerobot --output DIR`: logged episodes as datasets.

Exit code 0: all episodes are in the datasets; 1: something was skipped, named on stderr, or could
not be written; 2: bad usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.commands.picture_size import picture_size
from fetch_hand_sim.episode_log import (
    EpisodeArrays,
    EpisodeReadError,
    expand_episodes,
)
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.episodes.export import export_minari, export_parquet
from msgs_spec.command_line import (
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
)

_NAME = 'export_episodes'
_NEED_STEPS = {'minari': 'Minari', 'lerobot': 'LeRobot'}


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('path', type=Path, help='an episode, or a directory of episodes')
    parser.add_argument('--to', choices=('parquet', 'minari', 'lerobot'), required=True)
    parser.add_argument('--output', type=Path, required=True, help='directory to write to')
    parser.add_argument(
        '--name', default='logged-v0', help='of a Minari dataset; default: logged-v0'
    )
    parser.add_argument(
        '--pictures',
        type=picture_size,
        metavar='WxH',
        help='films of this size in a LeRobot dataset; default: none',
    )
    parser.add_argument('--camera', help='of the model, for --pictures; default: a good view')
    options = parser.parse_args(arguments)
    if options.pictures and options.to != 'lerobot':
        parser.error(f'--pictures is for --to lerobot, not {options.to}')
    if options.camera and not options.pictures:
        parser.error('--camera needs --pictures')
    if options.pictures and any(side % 2 for side in options.pictures):
        parser.error('--pictures: even sides are allowed')
    return options


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    options = _parse(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    require_extra('data')
    skipped: list[EpisodeReadError] = []
    episodes: list[EpisodeArrays] = []
    try:
        paths = expand_episodes(options.path)
        with progress('episodes', len(paths)) as advance:
            for path in paths:
                try:
                    episodes.append(_load(path, options.to))
                except EpisodeReadError as error:
                    skipped.append(error)
                advance(1)
    except EpisodeReadError as error:
        raise UsageError(str(error)) from None
    for reason in skipped:
        complain(_NAME, f'skipped {reason}')
    if not episodes and skipped:
        return EXIT_USAGE
    if not episodes:
        raise UsageError(f'{options.path} holds no episode')
    by_task: dict[str, list[EpisodeArrays]] = {}
    for episode in episodes:
        by_task.setdefault(episode.spec.name, []).append(episode)
    for task, group in by_task.items():
        done = f'{len(group)} episodes of {task}: {_export(options, group)}'
        say(done)
    return EXIT_FAILURE if skipped else EXIT_SUCCESS


def _load(path: Path, to: str) -> EpisodeArrays:
    """Reads an episode.

    Raises:
        EpisodeReadError: If it cannot be read, or a dataset of this kind cannot hold it.
    """
    episode = load_episode(path)
    if to in _NEED_STEPS and len(episode) == 0:
        raise EpisodeReadError(f'{path}: no step was taken, and {_NEED_STEPS[to]} needs one')
    return episode


def _export(options: argparse.Namespace, episodes: Sequence[EpisodeArrays]) -> str:
    if options.to == 'parquet':
        return ', '.join(str(path) for path in export_parquet(episodes, options.output))
    if options.to == 'lerobot':
        return f'LeRobot dataset {_export_lerobot(options, episodes)}'
    dataset_id = export_minari(episodes, options.output, options.name)
    return f'Minari dataset {dataset_id} in {options.output}'


def _export_lerobot(options: argparse.Namespace, episodes: Sequence[EpisodeArrays]) -> Path:
    # Films are drawn with MuJoCo, which the other kinds do without.
    from fetch_hand_sim.datasets.lerobot import export_lerobot
    from fetch_hand_sim.datasets.lerobot_film import Camera

    camera = None
    if options.pictures is not None:
        width, height = options.pictures
        camera = Camera(width, height, options.camera)
    try:
        return export_lerobot(episodes, options.output, camera)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except RuntimeError as error:
        raise CommandError(str(error)) from None


if __name__ == '__main__':
    sys.exit(main())
