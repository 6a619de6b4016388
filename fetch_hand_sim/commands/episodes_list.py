"""List an episode, or the episodes in a folder, as a table.

Exit code 0: all episodes were read; 1: an episode was skipped (stderr names it); 2: bad usage.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from fetch_hand_sim.commands.options import add_filter_options, is_wanted
from fetch_hand_sim.episode_log import (
    EpisodeLogError,
    EpisodeReadError,
    EpisodeSummary,
    expand_episodes,
    find_leftovers,
    read_summary,
)
from fetch_hand_sim.episode_log.files import folders_below, metadata_file, read_each
from fetch_hand_sim.episode_log.metadata import integer_or_none
from msgs_spec.text import counted, printable
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandParser,
    complain,
    run_command,
    show_table,
    usage_errors,
)

_NAME = 'fetch_hand_sim episodes list'
_COLUMNS = (
    'episode',
    'task',
    'seed',
    'steps',
    'return',
    'success',
    'seconds',
    'KiB',
    'ended',
    'late commands',
)
_NUMBERS = frozenset({'seed', 'steps', 'return', 'seconds', 'KiB', 'late commands'})
# Wide enough for every column. A narrow terminal wraps lines, which keeps names whole.
_WIDEST = 400
_LONGEST_CELL = 60


def make_table(episodes: Sequence[EpisodeSummary]) -> Table:
    """Return a table with one row for each episode."""
    table = Table(box=None, pad_edge=False, header_style='bold')
    for name in _COLUMNS:
        table.add_column(name, justify='right' if name in _NUMBERS else 'left', no_wrap=True)
    for episode in episodes:
        table.add_row(*(Text(_shown(cell)) for cell in _cells(episode)))
    return table


def _cells(episode: EpisodeSummary) -> list[str]:
    metadata, outcome = episode.metadata, episode.outcome
    success = {True: 'yes', False: 'no', None: '?'}
    return [
        _name(episode.path),
        metadata.get('task', '?'),
        _known(integer_or_none(metadata, 'seed')),
        _known(outcome.steps),
        _known(outcome.episode_return),
        success[outcome.is_success],
        f'{episode.duration_s:.2f}',
        f'{episode.size_bytes / 1024:.0f}',
        'complete' if outcome.is_complete else f'interrupted: {outcome.reason or "?"}',
        '-' if outcome.late_commands is None else str(outcome.late_commands),
    ]


def _name(file: Path) -> str:
    """Return the name of the bag directory that contains the file of an episode.

    If the directory has no `metadata.yaml`, return the file name without `_0.mcap`.
    """
    directory = file.absolute().parent
    is_bag = metadata_file(directory).is_file()
    return directory.name if is_bag else file.stem.removesuffix('_0')


def _known(number: int | float | None) -> str:
    return '?' if number is None else f'{number:g}' if isinstance(number, float) else str(number)


def _shown(cell: str) -> str:
    """Make a text printable and shorten it to `_LONGEST_CELL` characters."""
    text = printable(cell)
    return text if len(text) <= _LONGEST_CELL else f'{text[: _LONGEST_CELL - 3]}...'


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument('path', type=Path, help='an episode, or a folder of episodes')
    add_filter_options(parser)
    parser.add_argument('--json', action='store_true', help='print a JSON array instead of a table')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = _parse(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    errors: list[EpisodeReadError] = []
    with usage_errors((EpisodeReadError, EpisodeLogError)):
        episodes = list(read_each(expand_episodes(options.path), read_summary, errors.append))
        leftovers = find_leftovers(options.path) if options.path.is_dir() else []
    shown = [each for each in episodes if is_wanted(options, each.metadata.get('task'), each)]
    if options.json:
        print(json.dumps([_as_json(episode) for episode in shown], indent=2))
    else:
        if shown:
            show_table(make_table(shown), _WIDEST)
        complete = [each.outcome for each in shown if each.outcome.is_complete]
        successes = sum(outcome.is_success is True for outcome in complete)
        interrupted, filtered = len(shown) - len(complete), len(episodes) - len(shown)
        note = f' ({interrupted} interrupted)' if interrupted else ''
        listed, won = counted(len(shown), 'episode'), counted(successes, 'success')
        print(f'{listed}{note}, {won}; {filtered} filtered')
        if not (episodes or errors) and (below := folders_below(options.path)):
            print(f'episodes are in {below}')
    for leftover in leftovers:
        remedy = '' if leftover.problem else '; complete it with fetch_hand_sim episodes recover'
        print(f'{leftover}{remedy}', file=sys.stderr if options.json else sys.stdout)
    for skipped in errors:
        complain(_NAME, f'skipped {skipped}')
    return EXIT_FAILURE if errors else EXIT_SUCCESS


def _as_json(episode: EpisodeSummary) -> dict[str, Any]:
    """Return the JSON object that `--json` prints for an episode; unknown values are None."""
    metadata, outcome = episode.metadata, episode.outcome
    return {
        'path': str(episode.path),
        'task': metadata.get('task'),
        'seed': integer_or_none(metadata, 'seed'),
        'steps': outcome.steps,
        'late_commands': outcome.late_commands,
        'return': outcome.episode_return,
        'success': outcome.is_success,
        'seconds': episode.duration_s,
        'bytes': episode.size_bytes,
        'complete': outcome.is_complete,
        'reason': outcome.reason,
    }
