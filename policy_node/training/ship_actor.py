"""`ship_actor`: puts the best actor of a run into the package, unless a better one is there."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from fetch_hand_sim.simulation import Simulation
from msgs_spec.command_line import EXIT_FAILURE, EXIT_SUCCESS, UsageError, run_command
from policy_node.policies import checkpoint
from policy_node.training.evaluate_policy import FIRST_SEED, print_table
from policy_node.training.evaluation.episodes import evaluate, summarize
from policy_node.training.learning.run_folder import BEST_FILE, STATE_FILE, companion_file
from policy_node.training.learning.run_log import draw_curve, read_progress
from policy_node.training.learning.training_state import TrainingState, read_state, write_state

_NAME = 'ship_actor'
ACTORS = Path(__file__).parents[1] / 'actors'


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog=_NAME, description=__doc__)
    add = parser.add_argument
    add('run', type=Path, help='output folder of train_her')
    add('--episodes', type=int, default=1000, help='default: 1000')
    add('--num-envs', type=int, default=100, help='simulations in the batch; default: 100')
    add('--threads', type=int, default=0, help='simulation threads; default: all cores')
    add('--checkpoint', default=BEST_FILE, help=f'file in the run; default: {BEST_FILE}')
    add('--actors', type=Path, default=ACTORS, help='where to; default: the package')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    try:
        return EXIT_SUCCESS if ship(options) else EXIT_FAILURE
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from None


def ship(options: argparse.Namespace) -> bool:
    """Evaluates and, if it is better than the shipped actor, copies what belongs to an actor."""
    actor, info = checkpoint.load(options.run / options.checkpoint)
    num_envs = min(options.num_envs, options.episodes)
    simulation = Simulation(
        info.task, num_envs=num_envs, num_threads=options.threads, control_hz=info.control_hz
    )
    summary = summarize(evaluate(simulation, actor, options.episodes, FIRST_SEED))
    print_table({'policy': str(options.run), 'task': info.task, **summary})
    shipped = options.actors / f'{info.task}.json'
    if shipped.is_file() and not is_better(summary, json.loads(shipped.read_text())):
        print(f'ship_actor: the actor in {options.actors} is at least as good; nothing changed')
        return False
    target = options.actors / f'{info.task}.safetensors'
    command = commands_of(options.run) or info.command
    checkpoint.save(target, actor, replace(info, success=summary, command=command))
    report = {
        'actor': info.task,
        'sha256': checkpoint.checkpoint_hash(target),
        'env_steps': info.env_steps,
        'command': command,
        'init_from': info.init_from,
        'source_revision': info.source_revision,
        **summary,
    }
    shipped.write_text(json.dumps(report, indent=2) + '\n')
    if (options.run / STATE_FILE).is_file():
        ship_critic(options.run / STATE_FILE, target)
    title = f'{info.task}, {info.config["recipe"]} recipe, seed {info.seed}'
    draw_curve(read_progress(options.run / 'progress.csv'), title, target.with_suffix('.png'))
    return True


def ship_critic(state_file: Path, actor: Path) -> None:
    """Puts the critic of a run beside its shipped actor, so that training can go on from there.

    The actor holds its normalisers itself; optimisers start fresh.
    """
    state = read_state(state_file)
    tensors = {name: value for name, value in state.tensors.items() if name.startswith('critic.')}
    extra = {'config': state.extra['config'], 'actor_sha256': checkpoint.checkpoint_hash(actor)}
    write_state(companion_file(actor), TrainingState(tensors, state.counters, extra))


def commands_of(run: Path) -> str:
    """Every command of a run in order, the first and those that resumed it; '' if unknown."""
    path = run / 'command.txt'
    return ' && '.join(path.read_text().splitlines()) if path.is_file() else ''


def is_better(new: dict[str, Any], old: dict[str, Any]) -> bool:
    """Whether an evaluation is better: by last-step success, then by return."""
    keys = ('success_gymnasium', 'mean_return')
    return [new[key] for key in keys] > [old[key] for key in keys]


if __name__ == '__main__':
    sys.exit(main())
