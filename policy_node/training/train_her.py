"""`train_her`: trains an actor with DDPG and hindsight experience replay."""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any

from msgs_spec.tasks import TASKS, task_spec
from policy_node.training.learning.config import (
    RECIPES,
    TrainConfig,
    config_from_dict,
    parse_assignment,
    recipe_config,
)

if TYPE_CHECKING:
    from policy_node.training.learning.initial_networks import InitialNetworks
    from policy_node.training.learning.replay import Episodes
    from policy_node.training.learning.trainer import Trainer


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(
        prog='train_her',
        description=__doc__,
        epilog='Several workers: torchrun --nproc-per-node N -m policy_node.training.train_her ...',
    )
    add = parser.add_argument
    add('--task', choices=list(TASKS), metavar='TASK', help=', '.join(TASKS))
    add('--recipe', choices=RECIPES, default='best', help='default: best')
    add('--seed', type=int)
    add('--num-envs', type=int, help='simulations, of all workers')
    add(
        '--threads',
        type=int,
        dest='simulation_threads',
        help='simulation threads; default: what tensors leave',
    )
    add('--torch-threads', type=int, help='threads of one tensor operation')
    add('--steps', type=int, dest='total_steps', help='environment steps of the run')
    add('--time-limit', type=float, help='seconds')
    add('--success-target', type=float, help='end when an evaluation reaches it')
    add('--her', action=argparse.BooleanOptionalAction, default=True, help='hindsight on or off')
    add('--strategy', help='final, future, episode, random, futureactual or none')
    add('--reward-type', help='sparse or dense')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='any field of TrainConfig')
    add('--output', type=Path, help='default: runs/<task>_<recipe>_seed<seed>')
    add('--resume', type=Path, help='folder of a run to continue; its configuration is kept')
    add('--init-from', metavar='RUN', help='run folder or actor whose networks it starts from')
    add('--from-episodes', type=Path, metavar='DIR', help='logged episodes to learn from as well')
    return parser.parse_args(arguments)


_FIELD_OPTIONS = (
    'seed',
    'num_envs',
    'simulation_threads',
    'torch_threads',
    'total_steps',
    'time_limit',
    'success_target',
    'strategy',
    'reward_type',
    'init_from',
)


def config_from_arguments(options: argparse.Namespace) -> TrainConfig:
    """Builds the configuration: recipe or resumed run, then options, then `--set`.

    Raises:
        ValueError: If something is missing, unknown or not allowed.
    """
    overrides: dict[str, Any] = {
        name: getattr(options, name)
        for name in _FIELD_OPTIONS
        if getattr(options, name) is not None
    }
    if not options.her:
        if overrides.get('strategy', 'none') != 'none':
            raise ValueError(f'--no-her excludes --strategy {overrides["strategy"]}')
        overrides['strategy'] = 'none'
    overrides.update(parse_assignment(text) for text in options.set)
    if options.resume is None:
        if options.task is None:
            raise ValueError(f'--task is missing; allowed: {", ".join(TASKS)}')
        return recipe_config(options.task, options.recipe, **overrides)
    from policy_node.training.learning.run_folder import STATE_FILE
    from policy_node.training.learning.training_state import read_state

    if options.init_from is not None:
        raise ValueError('--init-from excludes --resume: a run goes on with its own networks')
    stored = read_state(options.resume / STATE_FILE).extra['config']
    if options.task not in (None, stored['task']):
        raise ValueError(f'{options.resume} is a run of {stored["task"]}, not of {options.task}')
    return config_from_dict({**stored, **overrides})


def source_revision() -> str:
    """Git revision of the source with `-dirty` where it differs, or the installed version."""
    folder = Path(__file__).parent
    command = ['git', '-C', str(folder), 'describe', '--always', '--dirty', '--abbrev=40']
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode == 0:
        return result.stdout.strip()
    from importlib.metadata import PackageNotFoundError, version

    try:
        return f'fetch_hand_sim {version("fetch_hand_sim")}'
    except PackageNotFoundError:
        return 'unknown'


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    try:
        config = config_from_arguments(options)
        return train(config, options, sys.argv[1:] if arguments is None else arguments)
    except (ValueError, TypeError) as error:
        print(f'train_her: {error}', file=sys.stderr)
        return 2


def train(config: TrainConfig, options: argparse.Namespace, arguments: Sequence[str]) -> int:
    """Trains as configured and reports how it went."""
    from policy_node.training.learning.ddpg import choose_device
    from policy_node.training.learning.distributed import join_workers, leave_workers
    from policy_node.training.learning.run_folder import STATE_FILE
    from policy_node.training.learning.run_log import RunLog
    from policy_node.training.learning.trainer import Trainer, TrainingError

    output = options.resume or options.output
    output = output or Path('runs') / f'{config.task}_{config.recipe}_seed{config.seed}'
    if options.resume is None and (output / STATE_FILE).exists():
        raise ValueError(f'{output} holds a run; continue it with --resume or choose another')
    networks = None
    if config.init_from and options.resume is None:
        config, networks = _read_initial_networks(config)
    experience = _read_experience(config, options.from_episodes)
    output.mkdir(parents=True, exist_ok=True)
    workers = join_workers(choose_device(config.device))
    command = shlex.join(['train_her', *arguments])
    trainer = Trainer(config, output, workers, command, source_revision(), networks)
    if options.resume is not None:
        trainer.resume(output / STATE_FILE)
    if experience is not None:
        trainer.add_experience(experience)
    log = None
    if workers.is_first:
        with (output / 'command.txt').open('a') as file:
            file.write(command + '\n')
        log = RunLog(output, config.total_steps, config.time_limit, trainer.counters.env_steps)
    try:
        with _stop_on_signals(trainer):
            reason = trainer.train(log)
    except TrainingError as error:
        print(f'train_her: {error}; the last checkpoint is kept in {output}', file=sys.stderr)
        return 1
    finally:
        if log is not None:
            log.close()
        leave_workers(workers)
    if workers.is_first:
        _report(config, output, reason, trainer.counters)
    return 0


def _read_initial_networks(config: TrainConfig) -> tuple[TrainConfig, InitialNetworks]:
    """Reads the networks to start from; a critic that must start from nothing learns first.

    Raises:
        ValueError: If there are none of that name or they do not fit.
    """
    from policy_node.training.learning.initial_networks import CRITIC_FIRST, read_initial_networks

    networks = read_initial_networks(config.init_from)
    networks.require_fit(config)
    if not networks.has_critic and config.critic_first == 0:
        config = dataclasses.replace(config, critic_first=CRITIC_FIRST)
        print(
            f'{config.init_from} has no critic beside it: a new one learns for '
            f'{CRITIC_FIRST:,} updates before the actor does',
            file=sys.stderr,
        )
    return config, networks


def _read_experience(config: TrainConfig, directory: Path | None) -> Episodes | None:
    """Loads logged episodes and says what was left out; None without a directory.

    Raises:
        ValueError: If there are none to learn from, or more than the replay holds.
    """
    if directory is None:
        return None
    from policy_node.training.learning.logged_episodes import read_experience

    episodes, skipped = read_experience(directory, task_spec(config.task), config.control_hz)
    transitions = len(episodes) * episodes.ticks
    if transitions > config.replay_transitions:
        raise ValueError(
            f'{directory} holds {transitions} transitions, the replay {config.replay_transitions}; '
            f'allow more with --set replay_transitions={transitions}'
        )
    left_out = f'; {len(skipped)} left out, first: {skipped[0]}' if skipped else ''
    print(f'{len(episodes)} episodes from {directory}{left_out}', file=sys.stderr)
    return episodes


@contextlib.contextmanager
def _stop_on_signals(trainer: Trainer) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the run after the cycle; a second one ends it at once."""

    def handle(number: int, frame: FrameType | None) -> None:
        del frame
        trainer.stop(f'stopped by {signal.Signals(number).name}')
        signal.signal(number, signal.SIG_DFL)

    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, handle) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _report(config: TrainConfig, output: Path, reason: str, counters: Any) -> None:
    from policy_node.training.learning.run_log import draw_curve, read_progress

    title = f'{config.task}, {config.recipe} recipe, seed {config.seed}'
    draw_curve(read_progress(output / 'progress.csv'), title, output / 'curve.png')
    best = f'{counters.best_success:.3f}' if counters.best_success >= 0 else 'not evaluated'
    print(
        f'{reason}: {counters.env_steps:,} steps, {counters.updates:,} updates, '
        f'{counters.seconds:.0f} s, best success {best}; output in {output}'
    )


if __name__ == '__main__':
    sys.exit(main())
