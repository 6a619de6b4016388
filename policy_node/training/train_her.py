"""Train a policy with DDPG and hindsight experience replay."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgs_spec.tasks import TASKS, task_spec
from msgs_spec.text import counted
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    given_command,
    require_extra,
    run_command,
    say,
)
from policy_node.training.configuration.config import FIELDS, TrainConfig
from policy_node.training.configuration.flat import (
    add_field_options,
    given_fields,
    with_assignments,
)
from policy_node.training.configuration.recipes import recipe_config

if TYPE_CHECKING:
    from policy_node.training.experience.replay import Episodes


_NAME = 'fetch_hand_sim train'
# Fields that choose the recipe.
_OWN_OPTIONS = ('task', 'recipe')


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(
        prog=_NAME,
        description=__doc__,
        epilog='Several workers: torchrun --nproc-per-node N -m fetch_hand_sim train ...',
    )
    add = parser.add_argument
    add('--task', choices=list(TASKS), metavar='TASK', help=', '.join(TASKS))
    add('--recipe', choices=FIELDS['recipe'].choices, help='default: best')
    add('--her', action=argparse.BooleanOptionalAction, help='hindsight on or off; default: on')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='set a field')
    add('--output', type=Path, help='default: runs/<task>_<recipe>_seed<seed>')
    add('--resume', type=Path, help='folder of a run to continue; its configuration is kept')
    add('--from-episodes', type=Path, metavar='DIR', help='also learn from logged episodes')
    add_field_options(parser, _OWN_OPTIONS)
    return parser.parse_args(arguments)


def config_from_arguments(options: argparse.Namespace) -> TrainConfig:
    """Return the configuration that the options choose.

    The recipe or the resumed run gives the values; the options and `--set` replace some of them.

    Raises:
        ValueError: If a value is missing, unknown or not allowed.
    """
    overrides = with_assignments(given_fields(options), options.set)
    if options.her is False:
        if overrides.get('strategy', 'none') != 'none':
            raise ValueError(f'--no-her excludes --strategy {overrides["strategy"]}')
        overrides['strategy'] = 'none'
    config = _configured(options, overrides)
    if options.her and config.strategy == 'none':
        raise ValueError('--her excludes strategy none: give another --strategy')
    return config


def _configured(options: argparse.Namespace, overrides: dict[str, Any]) -> TrainConfig:
    """Return the configuration of the recipe or the resumed run, changed by `overrides`.

    Raises:
        ValueError: If `--task` is missing, options exclude each other or a value is not allowed.
    """
    task, recipe = (overrides.pop(name, None) for name in _OWN_OPTIONS)
    if options.resume is not None:
        if options.output is not None:
            raise ValueError(f'--output excludes --resume: the run stays in {options.resume}')
        from policy_node.training.runs.run import resumed_config

        return resumed_config(options.resume, task, recipe, overrides)
    if task is None:
        raise ValueError(f'--task is missing; allowed: {", ".join(TASKS)}')
    return recipe_config(task, recipe or 'best', **overrides)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    command = given_command(_NAME, arguments)
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    require_extra('train')
    from policy_node.training.machine import is_first_worker
    from policy_node.training.runs.run import train_run
    from policy_node.training.runs.run_folder import default_folder
    from policy_node.training.runs.training_state import TrainingError

    try:
        config = config_from_arguments(options)
        output = options.resume or options.output or default_folder(config)
        experience = _read_experience(config, options.from_episodes)
        resume = options.resume is not None
        ending = train_run(config, output, resume=resume, command=command, experience=experience)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except TrainingError as error:
        raise CommandError(str(error)) from None
    counters = ending.counters
    best = f'{counters.best_success:.3f}' if counters.best_success >= 0 else 'not evaluated'
    if is_first_worker():
        say(
            f'{ending.reason}: {counters.env_steps:,} steps, {counters.updates:,} updates, '
            f'{counters.seconds:.0f} s, best success {best}; output in {output}'
        )
    return 128 + ending.signal if ending.signal else EXIT_SUCCESS


def _read_experience(config: TrainConfig, directory: Path | None) -> Episodes | None:
    """Load the logged episodes in `directory` and report skipped ones; None without a directory.

    Raises:
        ValueError: If a setting, such as algorithm `ppo`, cannot use logged episodes, no episode is
            usable, or the episodes do not all fit into the replay.
    """
    if directory is None:
        return None
    excluded = {
        f'algorithm {config.algorithm}': (
            config.algorithm in ('ppo', 'imitation'),
            'it learns only from its own episodes',
        ),
        'longest_hold above 1': (config.longest_hold > 1, 'logged actions have no length'),
        'subgoal_every': (config.subgoal_every > 0, 'logged episodes have no subgoals'),
        'past_actions': (config.past_actions > 0, 'logged observations have no past actions'),
        'gamble': (config.gamble, 'in logged episodes gambles end nothing'),
    }
    for name, (is_set, why) in excluded.items():
        if is_set:
            raise ValueError(f'{name} excludes --from-episodes: {why}')
    from policy_node.training.experience.episode_files import read_experience

    task = task_spec(config.task, control_hz=config.control_hz)
    episodes, skipped = read_experience(directory, task, config.control_hz)
    transitions = len(episodes) * episodes.ticks
    if transitions > config.replay_transitions:
        raise ValueError(
            f'{directory} contains {transitions} transitions, '
            f'the replay {config.replay_transitions}; '
            f'allow more with --set replay_transitions={transitions}'
        )
    left_out = f'; {len(skipped)} left out, first: {skipped[0]}' if skipped else ''
    complain(_NAME, f'{counted(len(episodes), "episode")} from {directory}{left_out}')
    return episodes


if __name__ == '__main__':
    sys.exit(main())
