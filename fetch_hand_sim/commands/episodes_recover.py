"""Complete the files of episodes that a crash or a full disk interrupted.

Exit code 0: no recovery failed; 1: an episode could not be recovered (stderr names it); 2: bad
usage.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.episode_log import (
    EpisodeInUseError,
    EpisodeLogError,
    EpisodeReadError,
    Leftover,
    files,
    find_leftovers,
    read_summary,
    recover_episode,
)
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandParser,
    UsageError,
    complain,
    progress,
    run_command,
    say,
    usage_errors,
)

_NAME = 'fetch_hand_sim episodes recover'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument(
        'directory', type=Path, help='folder of episodes, or one unfinished episode'
    )
    parser.add_argument('--dry-run', action='store_true', help='only list unfinished episodes')
    options = parser.parse_args(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    with usage_errors(EpisodeLogError):
        # Path.is_dir raises where a name is too long.
        if not os.path.isdir(options.directory):
            raise UsageError(f'{options.directory} is not a folder')
        leftovers = _find(options.directory)
    failures = 0
    with progress('unfinished episodes', len(leftovers)) as advance:
        for leftover in leftovers:
            if leftover.problem:
                complain(_NAME, leftover)
                failures += 1
            else:
                say(str(leftover))
                failures += not (options.dry_run or _recover(leftover.path))
            advance(1)
    if not leftovers:
        say(f'{options.directory}: no unfinished episode')
    return EXIT_FAILURE if failures else EXIT_SUCCESS


def _find(directory: Path) -> list[Leftover]:
    """Return the unfinished episodes in a folder, or only `directory` if it is one itself."""
    path = Path(os.path.abspath(directory))
    if files.active_name(path) is None:
        return find_leftovers(directory)
    return [each for each in find_leftovers(path.parent) if each.path == path]


def _without_messages(leftover: Path) -> str:
    aside = files.aside_path(leftover.parent, files.active_name(leftover) or '')
    what = f'moved to {aside}' if aside.exists() else 'removed'
    return f'{what}: {leftover} has no readable message'


def _recover(leftover: Path) -> bool:
    """Recover an episode and print the result; return False on an error, True if it is in use."""
    try:
        path = recover_episode(leftover)
        if path is None:
            say(_without_messages(leftover))
            return True
        episode = read_summary(path)
    except EpisodeInUseError as error:
        say(str(error))
        return True
    except (EpisodeLogError, EpisodeReadError) as error:
        complain(_NAME, error)
        return False
    aside = files.aside_path(leftover.parent, episode.path.parent.name)
    if aside.exists():
        say(f'the damaged file is kept in {aside}')
    state = 'complete' if episode.is_complete else 'marked as interrupted'
    say(
        f'recovered {episode.path.parent}: {episode.message_count} messages, '
        f'{episode.duration_s:.2f} s, {state}'
    )
    return True
