"""Measure the success rate of a policy over many new episodes; write table, JSON and CSV."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fetch_hand_sim.simulation import Simulation
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandParser,
    UsageError,
    progress,
    run_command,
    usage_errors,
)
from node_runtime.signals import EXIT_INTERRUPTED
from policy_node.policies.files import require_writable, to_csv, to_json
from policy_node.policies.loading import load_policy
from policy_node.policies.policy import LoadedPolicy
from policy_node.training.evaluation import (
    EpisodeOutcomes,
    compare,
    evaluate,
    print_table,
    summarize,
)
from policy_node.training.policy_options import (
    add_first_seed,
    add_policy_options,
    add_simulation_options,
    load_chosen_policy,
    make_chosen_simulation,
    policy_errors,
    write_result,
)

_NAME = 'fetch_hand_sim evaluate'
# `--json` without a file.
_STDOUT = Path('-')


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    add_policy_options(parser)
    add_simulation_options(parser, num_envs=100)
    add_first_seed(parser)
    add = parser.add_argument
    add(
        '--json',
        type=Path,
        nargs='?',
        const=_STDOUT,
        metavar='FILE',
        help='write the summary to a file, or print it instead of the table',
    )
    add('--csv', type=Path, help='write one row per episode')
    other = 'another policy (as --policy), compared on the same episodes: difference of success'
    add('--against', metavar='POLICY', help=other)
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    loaded = load_chosen_policy(options)
    simulation = make_chosen_simulation(options, loaded)
    other = None
    if options.against is not None:
        with usage_errors(prefix='--against: '):
            other = load_policy(options.against, loaded.task, trust=options.trust)
            other.require_rate(simulation.control_hz)
    if options.csv is not None and options.csv == options.json:
        raise UsageError(f'--json and --csv both name {options.csv}; allowed: two files')
    for file in (options.json, options.csv):
        if file not in (None, _STDOUT):
            require_writable(file)
    with policy_errors():
        outcomes, code = _evaluate(options, simulation, loaded)
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
        if other is not None and code == EXIT_SUCCESS:
            with policy_errors():
                others, code = _evaluate(options, simulation, other)
            report['against'] = {
                'policy': options.against,
                'sha256': other.sha256,
                **summarize(others),
                **compare(outcomes, others, options.success_rule),
            }
    finally:
        # Also if the other policy failed.
        _write(options, report, outcomes)
    return code


def _write(options: argparse.Namespace, report: dict[str, Any], outcomes: EpisodeOutcomes) -> None:
    try:
        if options.json == _STDOUT:
            print(to_json(report).decode(), end='', flush=True)
        else:
            print_table(report)
    finally:
        # Also if the terminal was closed.
        if options.json not in (None, _STDOUT):
            write_result(options.json, to_json(report))
        if options.csv is not None:
            write_result(options.csv, _to_csv(outcomes))


def _evaluate(
    options: argparse.Namespace, simulation: Simulation, policy: LoadedPolicy
) -> tuple[EpisodeOutcomes, int]:
    """Evaluate the policy; return the outcomes and the exit code of the command.

    After Ctrl-C, these are the outcomes of the batches that have ended and `EXIT_INTERRUPTED`.

    Raises:
        KeyboardInterrupt: After Ctrl-C, if no batch of episodes has ended yet.
    """
    finished: list[EpisodeOutcomes] = []
    with progress('episodes', options.episodes) as advance:

        def note(outcomes: EpisodeOutcomes) -> bool:
            advance(len(outcomes) - sum(len(each) for each in finished[-1:]))
            finished.append(outcomes)
            return False

        try:
            episodes, first_seed = options.episodes, options.first_seed
            bounded = replace(policy, is_bounded=True)
            return evaluate(simulation, bounded, episodes, first_seed, note), EXIT_SUCCESS
        except KeyboardInterrupt:
            if not finished:
                raise
            return finished[-1], EXIT_INTERRUPTED


def _to_csv(outcomes: EpisodeOutcomes) -> bytes:
    """Return the contents of a CSV file with one row per episode; flags are 0 or 1."""
    names = EpisodeOutcomes.__slots__
    columns = ((getattr(outcomes, name) * 1).tolist() for name in names)
    return to_csv(names, zip(*columns, strict=True))


if __name__ == '__main__':
    sys.exit(main())
