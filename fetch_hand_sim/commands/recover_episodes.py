"""`recover_episodes DIR`: makes valid bags of the episodes that a crash or a full disk cut off.

Exit code 0: nothing is left unfinished; 1: something could not be recovered, named on stderr;
2: bad usage.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.episode_log import (
    EpisodeLogError,
    EpisodeReadError,
    find_leftovers,
    read_summary,
    recover_episode,
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog='recover_episodes', description=__doc__)
    parser.add_argument('directory', type=Path, help='where episodes are collected')
    parser.add_argument('--dry-run', action='store_true', help='only name what is unfinished')
    options = parser.parse_args(arguments)
    try:
        if not options.directory.is_dir():
            raise EpisodeLogError(f'{options.directory} is no directory')
        leftovers = find_leftovers(options.directory)
    except EpisodeLogError as error:
        return _fail(error, 2)
    failures = 0
    for leftover in leftovers:
        print(leftover)
        if not options.dry_run:
            failures += _recover(leftover.path)
    if not leftovers:
        print(f'{options.directory}: no unfinished episode')
    return 1 if failures else 0


def _recover(leftover: Path) -> int:
    """Recovers one episode and says what came out; returns the number of failures."""
    try:
        episode = read_summary(recover_episode(leftover))
    except (EpisodeLogError, EpisodeReadError) as error:
        return _fail(error, 1)
    state = 'complete' if episode.is_complete else 'marked as interrupted'
    print(
        f'recovered {episode.path.parent}: {episode.message_count} messages, '
        f'{episode.duration_s:.2f} s, {state}'
    )
    return 0


def _fail(error: Exception, code: int) -> int:
    print(f'recover_episodes: {error}', file=sys.stderr)
    return code


if __name__ == '__main__':
    sys.exit(main())
