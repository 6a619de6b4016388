"""`check_episode PATH...`: runs logged episodes again and compares every message bit for bit.

Exit code 0: all are identical; 1: an episode differs; 2: bad usage, or a file cannot be checked.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.episode_log import EpisodeReadError, expand_episodes
from fetch_hand_sim.episodes.checker import EpisodeChecker


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    parser = argparse.ArgumentParser(prog='check_episode', description=__doc__)
    parser.add_argument(
        'paths', type=Path, nargs='+', metavar='PATH', help='episode, or directory of episodes'
    )
    options = parser.parse_args(arguments)
    checker = EpisodeChecker()
    codes = [_check(checker, path) for path in options.paths]
    return max(codes)


def _check(checker: EpisodeChecker, path: Path) -> int:
    """Checks an episode or all in a directory; returns the exit code for them."""
    code = 0
    try:
        episodes = expand_episodes(path)
        if not episodes:
            raise EpisodeReadError(f'{path} holds no episode')
    except EpisodeReadError as error:
        return _complain(error)
    for episode in episodes:
        try:
            result = checker.check(episode)
        except EpisodeReadError as error:
            code = max(code, _complain(error))
        else:
            print(result, flush=True)
            code = max(code, 1 if result.difference is not None else 0)
    return code


def _complain(error: EpisodeReadError) -> int:
    print(f'check_episode: {error}', file=sys.stderr)
    return 2


if __name__ == '__main__':
    sys.exit(main())
