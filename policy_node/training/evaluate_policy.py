"""Measure the success rate of a policy over many new episodes; write table, JSON and CSV."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.simulation import Simulation
from msgs_spec.parameters import LARGEST_SEED
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    progress,
    run_command,
    whole_number,
)
from node_runtime.signals import EXIT_INTERRUPTED
from policy_node.policies.files import to_csv, to_json, write_file
from policy_node.policies.policy import Policy
from policy_node.training.evaluation import (
    FIRST_SEED,
    EpisodeOutcomes,
    evaluate,
    print_table,
    summarize,
)
from policy_node.training.policy_options import (
    add_batch_options,
    add_disturbances_option,
    add_policy_options,
    add_reward_options,
    load_chosen_policy,
    make_chosen_simulation,
    policy_errors,
    require_writable,
)

_NAME = 'fetch_hand_sim evaluate'
# `--json` without a file.
_STDOUT = Path('-')


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    add_policy_options(parser)
    add_batch_options(parser, num_envs=100)
    add_disturbances_option(parser)
    add_reward_options(parser)
    add, seed = parser.add_argument, whole_number(0, LARGEST_SEED)
    add('--first-seed', type=seed, default=FIRST_SEED, help=f'default: {FIRST_SEED}')
    add(
        '--json',
        type=Path,
        nargs='?',
        const=_STDOUT,
        metavar='FILE',
        help='write the summary to a file, or print it instead of the table',
    )
    add('--csv', type=Path, help='write one row per episode')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    loaded = load_chosen_policy(options)
    simulation = make_chosen_simulation(options, loaded)
    for file in (options.json, options.csv):
        if file not in (None, _STDOUT):
            require_writable(file)
    with policy_errors():
        outcomes, code = _evaluate(options, simulation, replace(loaded, is_bounded=True))
    report = {
        'policy': options.policy or loaded.task,
        'task': loaded.task,
        'sha256': loaded.sha256,
        **summarize(outcomes),
        'reward_type': options.reward_type,
        'touched_rule': options.success_rule,
    }
    if not simulation.disturbances.is_off:
        report['disturbances'] = simulation.disturbances.as_dict()
    try:
        try:
            _show(report, options.json)
        finally:
            # Also if the terminal was closed.
            _write(report, outcomes, options)
    except BrokenPipeError:
        raise
    except OSError as error:
        raise CommandError(f'{error.filename or "output"}: {error.strerror}') from None
    return code


def _show(report: dict[str, Any], json_file: Path | None) -> None:
    """Print the summary as a table, or as JSON for `--json` without a file."""
    if json_file == _STDOUT:
        print(to_json(report).decode(), end='', flush=True)
    else:
        print_table(report)


def _write(report: dict[str, Any], outcomes: EpisodeOutcomes, options: argparse.Namespace) -> None:
    """Write the files of `--json` and `--csv`."""
    if options.json not in (None, _STDOUT):
        write_file(options.json, to_json(report))
    if options.csv is not None:
        write_file(options.csv, _to_csv(outcomes))


def _evaluate(
    options: argparse.Namespace, simulation: Simulation, policy: Policy
) -> tuple[EpisodeOutcomes, int]:
    """Return the outcomes and the exit code; after Ctrl-C the outcomes until then."""
    finished: list[EpisodeOutcomes] = []
    with progress('episodes', options.episodes) as advance:

        def note(outcomes: EpisodeOutcomes) -> bool:
            advance(len(outcomes) - sum(len(each) for each in finished[-1:]))
            finished.append(outcomes)
            return False

        try:
            episodes, first_seed = options.episodes, options.first_seed
            return evaluate(simulation, policy, episodes, first_seed, note), EXIT_SUCCESS
        except KeyboardInterrupt:
            if not finished:
                raise
            return finished[-1], EXIT_INTERRUPTED


def _to_csv(outcomes: EpisodeOutcomes) -> bytes:
    """Return a CSV file with a row per episode."""
    names = EpisodeOutcomes.__slots__
    columns = [np.asarray(getattr(outcomes, name)) for name in names]
    integers = [c.astype(int) if c.dtype == np.bool_ else c for c in columns]
    return to_csv(names, zip(*(column.tolist() for column in integers), strict=True))


if __name__ == '__main__':
    sys.exit(main())
