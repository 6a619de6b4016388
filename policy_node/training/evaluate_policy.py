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
from msgs_spec.tasks import TASKS, task_spec
from policy_node.policies import checkpoint
from policy_node.policies.actor import actor_path
from policy_node.training.evaluation.episodes import EpisodeOutcomes, evaluate, summarize
from policy_node.training.evaluation.floors import RandomPolicy, RestingPolicy
from policy_node.training.learning.collector import Policy

FLOORS = ('random', 'resting')
# Far from the seeds of training and of its evaluations.
FIRST_SEED = 2_000_000_000


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog='evaluate_policy', description=__doc__)
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
    add('--json', type=Path, help='write the summary')
    add('--csv', type=Path, help='write one row per episode')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    try:
        if options.episodes < 1 or options.num_envs < 1:
            raise ValueError(f'--episodes {options.episodes}, --num-envs {options.num_envs}: >= 1')
        policy, task, about = load_policy(options.actor, options.task)
        outcomes, summary = _run(options, policy, task)
    except (ValueError, ImportError) as error:
        print(f'evaluate_policy: {error}', file=sys.stderr)
        return 2
    report = {'actor': options.actor, 'task': task, **about, **summary}
    print_table(report)
    if options.json is not None:
        options.json.parent.mkdir(parents=True, exist_ok=True)
        options.json.write_text(json.dumps(report, indent=2) + '\n')
    if options.csv is not None:
        write_csv(outcomes, options.csv)
    return 0


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


def _run(
    options: argparse.Namespace, policy: Policy, task: str
) -> tuple[EpisodeOutcomes, dict[str, Any]]:
    simulation = Simulation(
        task,
        num_envs=min(options.num_envs, options.episodes),
        num_threads=options.threads,
        reward_type=options.reward_type,
        success_rule=options.success_rule,
    )
    outcomes = evaluate(simulation, policy, options.episodes, options.first_seed)
    rules = {'reward_type': options.reward_type, 'touched_rule': options.success_rule}
    return outcomes, {**summarize(outcomes), **rules}


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
