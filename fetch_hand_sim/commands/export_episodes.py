"""`export_episodes DIR --to parquet|minari --output DIR`: logged episodes as datasets.

Exit code 0: all episodes are in the datasets; 1: something was skipped, named on stderr, or could
not be written; 2: bad usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.episode_log import EpisodeArrays, EpisodeReadError, load_episodes
from fetch_hand_sim.episodes.export import ExportError, export_minari, export_parquet


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='export_episodes', description=__doc__)
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
    skipped: list[EpisodeReadError] = []
    try:
        episodes = load_episodes(options.path, on_skip=skipped.append)
    except EpisodeReadError as error:
        return _fail(error, 2)
    for reason in skipped:
        _fail(f'skipped {reason}', 1)
    if not episodes:
        return _fail(f'{options.path} holds no episode', 2)
    by_task: dict[str, list[EpisodeArrays]] = {}
    for episode in episodes:
        by_task.setdefault(episode.spec.name, []).append(episode)
    try:
        for task, group in by_task.items():
            print(f'{len(group)} episodes of {task}: {_export(options, group)}')
    except ExportError as error:
        return _fail(error, 1)
    return 1 if skipped else 0


def _export(options: argparse.Namespace, episodes: Sequence[EpisodeArrays]) -> str:
    if options.to == 'parquet':
        return ', '.join(str(path) for path in export_parquet(episodes, options.output))
    dataset_id = export_minari(episodes, options.output, options.name)
    return f'Minari dataset {dataset_id} in {options.output}'


def _fail(error: object, code: int) -> int:
    print(f'export_episodes: {error}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
