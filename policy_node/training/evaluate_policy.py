"""`evaluate_policy`: success of an actor over many fresh episodes, as table, JSON and CSV."""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

from fetch_hand_sim.simulation import Simulation
from msgs_spec.command_line import (
    EXIT_INTERRUPTED,
    EXIT_SUCCESS,
    CommandError,
    UsageError,
    progress,
    run_command,
)
from msgs_spec.tasks import TASKS, task_spec
from policy_node.policies import checkpoint
from policy_node.policies.actor import actor_path
from policy_node.training.evaluation.episodes import EpisodeOutcomes, evaluate, summarize
from policy_node.training.evaluation.floors import RandomPolicy, RestingPolicy
from policy_node.training.learning.collector import Policy

_NAME = 'evaluate_policy'
# What `--json` without a file means.
_STDOUT = Path('-')
FLOORS = ('random', 'resting')
# Far from the seeds of training and of its evaluations.
FIRST_SEED = 2_000_000_000


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog=_NAME, description=__doc__)
    add = parser.add_argument
    add(
        '--actor',
        required=True,
        help='shipped actor, checkpoint file, random, resting, or sb3:<class>:<file.zip>',
    )
    add('--task', choices=list(TASKS), metavar='TASK', help='default: the task of the checkpoint')
    add('--episodes', type=int, default=1000, help='default: 1000')
    add('--first-seed', type=int, default=FIRST_SEED, help=f'default: {FIRST_SEED}')
    add('--num-envs', type=int, default=100, help='simulations in the batch; default: 100')
    add('--threads', type=int, default=0, help='simulation threads; default: all cores')
    add('--success-rule', choices=('gymnasium', 'paper'), default='gymnasium', help='of the reward')
    add('--reward-type', choices=('sparse', 'dense'), default='sparse', help='of the return')
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
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    for name in ('episodes', 'num_envs'):
        if getattr(options, name) < 1:
            raise UsageError(f'--{name.replace("_", "-")} {getattr(options, name)}; allowed: >= 1')
    try:
        policy, task, about = load_policy(options.actor, options.task)
        simulation = _simulation(options, task)
    except (ValueError, ImportError) as error:
        raise UsageError(str(error)) from None
    outcomes, code = _evaluate(options, simulation, policy)
    rules = {'reward_type': options.reward_type, 'touched_rule': options.success_rule}
    report = {'actor': options.actor, 'task': task, **about, **summarize(outcomes), **rules}
    text = json.dumps(report, indent=2)
    if options.json == _STDOUT:
        print(text)
    else:
        print_table(report)
    try:
        if options.json not in (None, _STDOUT):
            options.json.parent.mkdir(parents=True, exist_ok=True)
            options.json.write_text(text + '\n')
        if options.csv is not None:
            write_csv(outcomes, options.csv)
    except OSError as error:
        raise CommandError(f'{error.filename}: {error.strerror}') from None
    return code


def _evaluate(
    options: argparse.Namespace, simulation: Simulation, policy: Policy
) -> tuple[EpisodeOutcomes, int]:
    """Returns what happened and the exit code; after Ctrl-C what had happened by then."""
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


def load_policy(actor: str, task: str | None) -> tuple[Policy, str, dict[str, Any]]:
    """Returns the policy called `actor`, its task, and what identifies it.

    Raises:
        ValueError: If there is no such actor, it does not fit the task, or the task is missing.
        ImportError: If a Stable-Baselines3 model is asked for and that is not installed.
    """
    if actor not in FLOORS and not actor.startswith('sb3:'):
        path = actor_path(actor)
        loaded, info = checkpoint.load(path, task)
        return loaded, info.task, {'sha256': checkpoint.checkpoint_hash(path)}
    if task is None:
        raise ValueError(f'--task is missing for --actor {actor}; allowed: {", ".join(TASKS)}')
    size = task_spec(task).robot.action_size
    if actor == 'random':
        return RandomPolicy(size), task, {}
    if actor == 'resting':
        return RestingPolicy(size), task, {}
    return _stable_baselines3(actor), task, {}


def _stable_baselines3(actor: str) -> Policy:
    parts = actor.split(':', 2)
    if len(parts) != 3 or not Path(parts[2]).is_file():
        raise ValueError(f'{actor!r} is not sb3:<class>:<file.zip> of an existing file')
    import stable_baselines3

    algorithm = getattr(stable_baselines3, parts[1], None)
    if algorithm is None or not hasattr(algorithm, 'load'):
        raise ValueError(f'stable_baselines3 has no algorithm {parts[1]!r}')
    # A replay buffer for hindsight would ask for its environment; predicting needs neither.
    replay: dict[str, Any] = {'replay_buffer_class': None, 'replay_buffer_kwargs': {}}
    policy: Policy = algorithm.load(parts[2], device='cpu', custom_objects=replay)
    return policy


def _simulation(options: argparse.Namespace, task: str) -> Simulation:
    return Simulation(
        task,
        num_envs=min(options.num_envs, options.episodes),
        num_threads=options.threads,
        reward_type=options.reward_type,
        success_rule=options.success_rule,
    )


_DIAGNOSES = {
    'stay': 'success at the next tick, given success at this one',
    'long_way': 'success where the goal is the long way round',
    'dropped': 'object below the palm at the end',
    'distance': 'median distance at the end, m',
    'rotation': 'median rotation at the end, rad',
}


def print_table(report: dict[str, Any]) -> None:
    """Prints rates with their 95 % intervals."""
    title = f'{report["task"]}: {report["actor"]}, {report["episodes"]} episodes'
    table = Table('measure', 'value', '95 % interval', title=title)
    names = {
        'success_gymnasium': 'success at the last step, gymnasium rule',
        'success_paper': 'success at the last step, paper rule',
        'touched': 'goal touched at least once',
    }
    for name, label in names.items():
        low, high = report[f'{name}_interval_95']
        table.add_row(label, f'{report[name]:.4f}', f'{low:.4f} ... {high:.4f}')
    for name, label in _DIAGNOSES.items():
        if name in report:
            table.add_row(label, f'{report[name]:.4f}', '')
    table.add_row('mean return', f'{report["mean_return"]:.3f}', '')
    table.add_row('diverged episodes', str(report['diverged']), '')
    Console().print(table)


def write_csv(outcomes: EpisodeOutcomes, path: Path) -> None:
    """Writes one row per episode."""
    names = EpisodeOutcomes.__slots__
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(names)
        columns = [np.asarray(getattr(outcomes, name)) for name in names]
        integers = [c.astype(int) if c.dtype == np.bool_ else c for c in columns]
        writer.writerows(zip(*(column.tolist() for column in integers), strict=True))


if __name__ == '__main__':
    sys.exit(main())
