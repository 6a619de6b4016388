"""Train a policy with DDPG and hindsight experience replay."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from msgs_spec.tasks import TASKS, task_spec
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandParser,
    UsageError,
    complain,
    given_command,
    require_extra,
    run_command,
    say,
)
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import (
    add_field_options,
    given_fields,
    with_assignments,
)
from policy_node.training.configuration.groups import Held, Hierarchical, Ppo
from policy_node.training.configuration.recipes import RECIPES, recipe_config

if TYPE_CHECKING:
    from policy_node.training.experience.replay import Episodes


_NAME = 'fetch_hand_sim train'
# Fields that say which recipe there is to start from.
_OWN_OPTIONS = ('task', 'recipe')
# A process that a signal ended returns 128 + its number, as shells say it.
EXIT_SIGNAL = 128


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = CommandParser(
        prog=_NAME,
        description=__doc__,
        epilog='Several workers: torchrun --nproc-per-node N -m fetch_hand_sim train ...',
    )
    add = parser.add_argument
    add('--task', choices=list(TASKS), metavar='TASK', help=', '.join(TASKS))
    add('--recipe', choices=RECIPES, help='default: best')
    add('--her', action=argparse.BooleanOptionalAction, help='hindsight on or off; default: on')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='a field by its name')
    add('--output', type=Path, help='default: runs/<task>_<recipe>_seed<seed>')
    add('--resume', type=Path, help='folder of a run to continue; its configuration is kept')
    add('--from-episodes', type=Path, metavar='DIR', help='logged episodes to learn from as well')
    add_field_options(parser, _OWN_OPTIONS)
    return parser.parse_args(arguments)


def config_from_arguments(options: argparse.Namespace) -> TrainConfig:
    """Builds the configuration: recipe or resumed run, then options, then `--set`.

    Raises:
        ValueError: If something is missing, unknown or not allowed.
    """
    overrides = with_assignments(given_fields(options, _OWN_OPTIONS), options.set)
    if options.her is False:
        if overrides.get('strategy', 'none') != 'none':
            raise ValueError(f'--no-her excludes --strategy {overrides["strategy"]}')
        overrides['strategy'] = 'none'
    config = _configured(options, overrides)
    if options.her and config.goals.strategy == 'none':
        raise ValueError('--her excludes strategy none: give another --strategy')
    return config


def _configured(options: argparse.Namespace, overrides: dict[str, Any]) -> TrainConfig:
    """The recipe, or the run that goes on, with fields replaced."""
    task, recipe = (_own_option(options, overrides, name) for name in _OWN_OPTIONS)
    if options.resume is not None:
        if options.output is not None:
            raise ValueError(f'--output excludes --resume: the run goes on in {options.resume}')
        from policy_node.training.runs.resumed_config import resumed_config

        return resumed_config(options.resume, task, recipe, overrides)
    if task is None:
        raise ValueError(f'--task is missing; allowed: {", ".join(TASKS)}')
    return recipe_config(task, recipe or 'best', **overrides)


def _own_option(options: argparse.Namespace, overrides: dict[str, Any], name: str) -> str | None:
    """What an option or `--set` says of a field, which leaves `overrides`; None if neither does.

    Raises:
        ValueError: If they contradict each other.
    """
    option: str | None = getattr(options, name)
    assigned: str | None = overrides.pop(name, None)
    if None not in (option, assigned) and option != assigned:
        raise ValueError(f'--{name} {option} excludes --set {name}={assigned}')
    return option or assigned


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    command = given_command(_NAME, arguments)
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    require_extra('train')
    from policy_node.training.machine.distributed import is_first_worker
    from policy_node.training.runs.run import train_run
    from policy_node.training.runs.run_folder import default_folder

    try:
        config = config_from_arguments(options)
        output = options.resume or options.output
        output = output or default_folder(config)
        experience = _read_experience(config, options.from_episodes)
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from None
    resume = options.resume is not None
    ending = train_run(config, output, resume=resume, command=command, experience=experience)
    counters = ending.counters
    best = f'{counters.best_success:.3f}' if counters.best_success >= 0 else 'not evaluated'
    if is_first_worker():
        say(
            f'{ending.reason}: {counters.env_steps:,} steps, {counters.updates:,} updates, '
            f'{counters.seconds:.0f} s, best success {best}; output in {output}'
        )
    return EXIT_SIGNAL + ending.signal if ending.signal else EXIT_SUCCESS


def _read_experience(config: TrainConfig, directory: Path | None) -> Episodes | None:
    """Loads logged episodes and says what was left out; None without a directory.

    Raises:
        ValueError: If there are none to learn from, or more than the replay holds.
    """
    if directory is None:
        return None
    if isinstance(config.learner, Ppo):
        raise ValueError('algorithm ppo excludes --from-episodes: it learns from its own alone')
    if config.find(Held):
        raise ValueError(
            'longest_hold above 1 excludes --from-episodes: their actions have no length'
        )
    if config.find(Hierarchical):
        raise ValueError('subgoal_every excludes --from-episodes: nobody gave them subgoals')
    if config.collect.gamble:
        raise ValueError('gamble excludes --from-episodes: gambles in them ended nothing')
    from policy_node.training.experience.logged_episodes import read_experience

    task = task_spec(config.task, control_hz=config.collect.control_hz)
    episodes, skipped = read_experience(directory, task, config.collect.control_hz)
    transitions = len(episodes) * episodes.ticks
    if transitions > config.replay.replay_transitions:
        raise ValueError(
            f'{directory} holds {transitions} transitions, '
            f'the replay {config.replay.replay_transitions}; '
            f'allow more with --set replay_transitions={transitions}'
        )
    left_out = f'; {len(skipped)} left out, first: {skipped[0]}' if skipped else ''
    complain(_NAME, f'{len(episodes)} episodes from {directory}{left_out}')
    return episodes


if __name__ == '__main__':
    sys.exit(main())
