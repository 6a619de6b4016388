"""`ship_actor`: copy an actor of a run into the package if it beats the shipped actor."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandParser,
    require_extra,
    run_command,
    usage_errors,
)
from policy_node.training.policy_options import add_batch_options

_NAME = 'ship_actor'
ACTORS = Path(__file__).parents[1] / 'actors'


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    add_batch_options(parser, num_envs=100)
    add = parser.add_argument
    add('run', type=Path, help='output folder of fetch_hand_sim train')
    add('--checkpoint', help='file in the run; default: the better of best and latest actor')
    add('--actors', type=Path, default=ACTORS, help='target folder; default: the package')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    require_extra('train')
    from policy_node.training.runs.shipping import ship

    with usage_errors((ValueError, OSError)):
        better = ship(
            options.run,
            options.actors,
            episodes=options.episodes,
            num_envs=options.num_envs,
            threads=options.threads,
            name=options.checkpoint,
        )
        return EXIT_SUCCESS if better else EXIT_FAILURE


if __name__ == '__main__':
    sys.exit(main())
