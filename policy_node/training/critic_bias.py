"""`critic_bias`: compare the values of a run's critic with the returns of its actor.

    python -m policy_node.training.critic_bias runs/block

A critic that overestimates values cannot show the actor which action is better. Values are
overestimated for two reasons. The actor prefers actions whose value is overestimated, and hindsight
goals treat every outcome as intended (docs/her_and_recipes.md).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandParser,
    require_extra,
    run_command,
    say,
    show_table,
    usage_errors,
    whole_number,
)

_NAME = 'critic_bias'


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=(__doc__ or '').splitlines()[0])
    parser.add_argument('run', type=Path, help='folder of a run')
    episodes = whole_number(2, 100_000)
    parser.add_argument('--episodes', type=episodes, default=128, help='default: 128')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    require_extra('train')
    from rich.table import Table

    from policy_node.training.values_and_returns import measure

    with usage_errors():
        comparisons = measure(options.run, options.episodes)
    say(f'{options.run}: {options.episodes} new episodes, without noise')
    table = Table()
    for name in ('tick', 'value', 'return', 'difference', 'correlation'):
        table.add_column(name, justify='right')
    for each in comparisons:
        value, total = each.value, each.episode_return
        numbers = (value, total, value - total, each.correlation)
        table.add_row(str(each.tick), *(f'{number:.2f}' for number in numbers))
    show_table(table)
    return EXIT_SUCCESS


if __name__ == '__main__':
    sys.exit(main())
