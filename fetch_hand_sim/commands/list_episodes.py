"""`list_episodes DIR`: the episodes in a directory as a table.

Exit code 0: everything was read; 1: something was skipped, named on stderr; 2: bad usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rich.console import Console
from rich.table import Table
from rich.text import Text

from fetch_hand_sim.episode_log import (
    EpisodeLogError,
    EpisodeReadError,
    find_episodes,
    find_leftovers,
    read_summary,
)
from fetch_hand_sim.episode_log.reader import printable
from fetch_hand_sim.episode_log.summary import EpisodeSummary
from msgs_spec.tasks import TASKS

_COLUMNS = ('episode', 'task', 'seed', 'steps', 'return', 'success', 'seconds', 'KiB', 'ended')
_NUMBERS = frozenset({'seed', 'steps', 'return', 'seconds', 'KiB'})
# A pipe has no width to fit into; this one fits every column.
_PIPE_WIDTH = 200


@dataclass(frozen=True, slots=True)
class Filter:
    """Which episodes to show; None shows both.

    Attributes:
        task: Name of the task.
        success: Whether the goal was reached at the end.
        complete: Whether the episode ran to its end.
    """

    task: str | None = None
    success: bool | None = None
    complete: bool | None = None

    def accepts(self, episode: EpisodeSummary) -> bool:
        """Whether an episode is to be shown."""
        is_success = episode.result.get('success') == 'true'
        return (
            self.task in (None, episode.metadata.get('task'))
            and self.success in (None, is_success)
            and self.complete in (None, episode.is_complete)
        )


def read_summaries(directory: Path) -> tuple[list[EpisodeSummary], list[EpisodeReadError]]:
    """Reads all episodes of a directory; what cannot be read comes as an error, in one line each.

    Raises:
        EpisodeReadError: If the directory itself cannot be read.
    """
    episodes, errors = [], []
    for path in find_episodes(directory):
        try:
            episodes.append(read_summary(path))
        except EpisodeReadError as error:
            errors.append(error)
    return episodes, errors


def make_table(episodes: Sequence[EpisodeSummary]) -> Table:
    """Returns the table of some episodes."""
    table = Table(box=None, pad_edge=False, header_style='bold')
    for name in _COLUMNS:
        table.add_column(name, justify='right' if name in _NUMBERS else 'left', no_wrap=True)
    for episode in episodes:
        table.add_row(*(Text(printable(cell)) for cell in _cells(episode)))
    return table


def _cells(episode: EpisodeSummary) -> list[str]:
    metadata, result = episode.metadata, episode.result
    success = {'true': 'yes', 'false': 'no'}
    return [
        episode.path.stem.removesuffix('_0'),
        metadata.get('task', '?'),
        metadata.get('seed', '?'),
        result.get('steps', '?'),
        _short(result.get('return', '?')),
        success.get(result.get('success', ''), '?'),
        f'{episode.duration_s:.2f}',
        f'{episode.size_bytes / 1024:.0f}',
        'complete' if episode.is_complete else f'interrupted: {result.get("reason", "?")}',
    ]


def _short(number: str) -> str:
    try:
        return f'{float(number):g}'
    except ValueError:
        return number


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog='list_episodes', description=__doc__)
    parser.add_argument('directory', type=Path, help='where episodes are collected')
    parser.add_argument('--task', choices=list(TASKS), metavar='TASK', help='only this task')
    success = parser.add_mutually_exclusive_group()
    success.add_argument('--success', action='store_true', default=None, help='only successes')
    success.add_argument(
        '--failure', dest='success', action='store_false', help='only failures', default=None
    )
    parser.add_argument(
        '--complete',
        action=argparse.BooleanOptionalAction,
        default=None,
        help='only episodes that ran to their end, or only interrupted ones',
    )
    return parser.parse_args(arguments)


def _complain(text: object) -> None:
    print(f'list_episodes: {text}', file=sys.stderr)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    options = _parse(arguments)
    try:
        episodes, errors = read_summaries(options.directory)
        leftovers = find_leftovers(options.directory)
    except (EpisodeReadError, EpisodeLogError) as error:
        _complain(error)
        return 2
    wanted = Filter(options.task, options.success, options.complete)
    shown = [episode for episode in episodes if wanted.accepts(episode)]
    console = Console(width=None if sys.stdout.isatty() else _PIPE_WIDTH)
    if shown:
        console.print(make_table(shown))
    successes = sum(episode.result.get('success') == 'true' for episode in shown)
    print(f'{len(shown)} episodes, {successes} successes; {len(episodes) - len(shown)} filtered')
    for leftover in leftovers:
        print(f'{leftover}; recover_episodes makes a bag of it')
    for skipped in errors:
        _complain(f'skipped {skipped}')
    return 1 if errors else 0


if __name__ == '__main__':
    sys.exit(main())
