"""`export_episodes DIR --to parquet|minari --output DIR`: logged episodes as datasets.

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
from fetch_hand_sim.episodes.export import export_parquet
from fetch_hand_sim.episodes.minari_export import export_minari, why_apart
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


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('path', type=Path, help='an episode, or a directory of episodes')
    parser.add_argument('--to', choices=('parquet', 'minari'), required=True)
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
    by_task: dict[str, list[EpisodeArrays]] = {}
    try:
        paths = expand_episodes(options.path)
        with progress('episodes', len(paths)) as advance:
            for path in paths:
                try:
                    _add(path, by_task, options.to)
                except EpisodeReadError as error:
                    skipped.append(error)
                advance(1)
    except EpisodeReadError as error:
        raise UsageError(str(error)) from None
    for reason in skipped:
        complain(_NAME, f'skipped {reason}')
    if not by_task and skipped:
        return EXIT_USAGE
    if not by_task:
        raise UsageError(f'{options.path} holds no episode')
    for task, written in _export(options, by_task).items():
        say(f'{len(by_task[task])} episodes of {task}: {written}')
    return EXIT_FAILURE if skipped else EXIT_SUCCESS


def _add(path: Path, by_task: dict[str, list[EpisodeArrays]], to: str) -> None:
    """Reads an episode and puts it beside those of its task.

    Raises:
        EpisodeReadError: If it cannot be read, or a dataset of this kind cannot hold it.
    """
    episode = load_episode(path)
    others = by_task.get(episode.spec.name)
    if to == 'minari' and len(episode) == 0:
        raise EpisodeReadError(f'{path}: no step was taken, and Minari needs one')
    if to == 'minari' and others and (why := why_apart(episode, others[0])):
        raise EpisodeReadError(f'{path}: {why}; a Minari dataset has one environment')
    by_task.setdefault(episode.spec.name, []).append(episode)


def _export(options: argparse.Namespace, by_task: dict[str, list[EpisodeArrays]]) -> dict[str, str]:
    """Writes all; returns for each task where it is."""
    if options.to == 'parquet':
        files = export_parquet(by_task, options.output)
        return {task: ', '.join(map(str, paths)) for task, paths in files.items()}
    ids = export_minari(by_task, options.output, options.name)
    return {task: f'Minari dataset {each} in {options.output}' for task, each in ids.items()}


if __name__ == '__main__':
    sys.exit(main())
