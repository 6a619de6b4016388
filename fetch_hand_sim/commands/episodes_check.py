"""Simulate logged episodes again and compare every message bit for bit.

Exit code 0: all episodes are identical; 1: an episode differs; 2: bad usage, or a file cannot be
checked.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fetch_hand_sim.episode_log import EpisodeReadError, expand_episodes
from fetch_hand_sim.episode_log.files import holds_no_episode
from fetch_hand_sim.episodes.checker import CheckResult, check_episode
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    EXIT_USAGE,
    CommandParser,
    complain,
    progress,
    run_command,
    say,
)

_NAME = 'fetch_hand_sim episodes check'


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    parser.add_argument(
        'paths', type=Path, nargs='+', metavar='PATH', help='an episode, or a folder of episodes'
    )
    parser.add_argument('--json', action='store_true', help='print one JSON array instead of lines')
    options = parser.parse_args(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    episodes, code = _expand(options.paths)
    results: list[CheckResult] = []
    try:
        code = max(code, _check(episodes, results, is_quiet=options.json))
    finally:
        if options.json:
            print(json.dumps([_as_json(result) for result in results], indent=2))
    return code


def _expand(paths: Sequence[Path]) -> tuple[list[Path], int]:
    """Return all episodes in the paths, and the exit code: 0, or 2 if a path has no episode."""
    episodes: list[Path] = []
    code = EXIT_SUCCESS
    for path in paths:
        try:
            found = expand_episodes(path)
            if not found:
                raise holds_no_episode(path)
        except EpisodeReadError as error:
            complain(_NAME, error)
            code = EXIT_USAGE
        else:
            episodes += found
    return episodes, code


def _check(episodes: Sequence[Path], results: list[CheckResult], is_quiet: bool) -> int:
    """Check episodes, append to `results`, print these unless `is_quiet`; return the exit code."""
    code = EXIT_SUCCESS
    with progress('episodes', len(episodes)) as advance:
        for episode in episodes:
            try:
                result = check_episode(episode)
            except EpisodeReadError as error:
                complain(_NAME, error)
                code = EXIT_USAGE
            else:
                results.append(result)
                code = max(code, EXIT_SUCCESS if result.difference is None else EXIT_FAILURE)
                if not is_quiet:
                    say(result)
            advance(1)
    return code


def _as_json(result: CheckResult) -> dict[str, Any]:
    values = dataclasses.asdict(result)
    return {**values, 'path': str(result.path), 'identical': result.difference is None}
