"""`export_episodes DIR --to parquet|minari|lerobot --output DIR`: logged episodes as datasets.

Exit code 0: all episodes are in the datasets; 1: something was skipped, named on stderr, or could
not be written; 2: bad usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.episode_log import (
    EpisodeArrays,
    EpisodeReadError,
    expand_episodes,
)
from fetch_hand_sim.episode_log.arrays import load_episode
from fetch_hand_sim.episodes.export import export_minari, export_parquet
from fetch_hand_sim.episodes.lerobot import export_lerobot
from msgs_spec.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    EXIT_USAGE,
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
    return parser.parse_args(arguments)


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
        return f'LeRobot dataset {export_lerobot(episodes, options.output)}'
    dataset_id = export_minari(episodes, options.output, options.name)
    return f'Minari dataset {dataset_id} in {options.output}'


if __name__ == '__main__':
    sys.exit(main())
