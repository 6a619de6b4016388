"""Options that commands share to choose a policy and simulations, and functions to apply them."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from fetch_hand_sim.simulation import Simulation
from msgs_spec.parameters import LARGEST_SEED
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, REWARD_TYPES, SUCCESS_RULES, TASKS
from node_runtime.command_line import CommandError, UsageError, usage_errors, whole_number
from policy_node.policies.files import write_file
from policy_node.policies.loading import POLICY_NAMES, load_policy
from policy_node.policies.policy import LoadedPolicy, PolicyError
from policy_node.training.evaluation import FIRST_SEED


def add_policy_options(parser: argparse.ArgumentParser) -> None:
    """Add the options `--policy`, `--task` and `--trust`, for `load_chosen_policy`."""
    add = parser.add_argument
    add('--policy', default='', help=POLICY_NAMES)
    add('--task', choices=list(TASKS), metavar='TASK', help='default: the task of the policy')
    add(
        '--trust',
        action='store_true',
        help='allow a .zip of Stable-Baselines3 or module:function, which run code of their own',
    )


def add_batch_options(parser: argparse.ArgumentParser, num_envs: int, episodes: int = 1000) -> None:
    """Add `--episodes` and `--num-envs` with these defaults, and `--threads`."""
    add, count = parser.add_argument, whole_number(1)
    add('--episodes', type=count, default=episodes, help=f'default: {episodes}')
    simulations = f'simulations in the batch; default: {num_envs}'
    add('--num-envs', type=count, default=num_envs, help=simulations)
    add('--threads', type=int, default=0, help='simulation threads; default: all cores')


def add_first_seed(parser: argparse.ArgumentParser, first_seed: int = FIRST_SEED) -> None:
    """Add the option `--first-seed` with this default."""
    meaning = f'episode i has this seed plus i; default: {first_seed}'
    seed = whole_number(0, LARGEST_SEED)
    parser.add_argument('--first-seed', type=seed, default=first_seed, help=meaning)


def add_simulation_options(parser: argparse.ArgumentParser, num_envs: int) -> None:
    """Add the options of `make_chosen_simulation`: batch, disturbances, success rule and reward."""
    add_batch_options(parser, num_envs)
    add = parser.add_argument
    presets = 'none, mild, hardware, severe, scaled as in hardware*0.5, a YAML file or JSON'
    add('--disturbances', default='none', help=f'of the robot: {presets}; default: none')
    rule = 'of rewards and `touched`'
    add('--success-rule', choices=SUCCESS_RULES, default='gymnasium', help=rule)
    add('--reward-type', choices=REWARD_TYPES, default='sparse', help='of the return')


def load_chosen_policy(options: argparse.Namespace) -> LoadedPolicy:
    """Load the policy that the options of `add_policy_options` choose.

    Raises:
        UsageError: If both `--policy` and `--task` are missing, or the policy cannot be loaded.
    """
    if not options.policy and options.task is None:
        raise UsageError('--policy and --task are missing; one of them is needed')
    with usage_errors():
        loaded = load_policy(options.policy, options.task, trust=options.trust)
    return loaded


@contextmanager
def policy_errors() -> Iterator[None]:
    """Turn a `PolicyError` in the `with` block into a `CommandError`, which ends the command."""
    try:
        yield
    except PolicyError as error:
        raise CommandError(str(error)) from None


def chosen_seeds(options: argparse.Namespace) -> range:
    """Return the seeds of `--first-seed` and `--episodes`; UsageError if the last is too large."""
    seeds = range(options.first_seed, options.first_seed + options.episodes)
    if seeds[-1] > LARGEST_SEED:
        raise UsageError(f'the last seed would be {seeds[-1]}; allowed: 0 ... {LARGEST_SEED}')
    return seeds


def make_chosen_simulation(options: argparse.Namespace, loaded: LoadedPolicy) -> Simulation:
    """Return the simulations for a policy, with the options of `add_simulation_options`.

    The options also include `--first-seed` (`add_first_seed`).

    Raises:
        UsageError: If an option does not fit the policy, or the last seed is too large.
    """
    chosen_seeds(options)
    with usage_errors():
        simulation = Simulation(
            loaded.task,
            num_envs=min(options.num_envs, options.episodes),
            num_threads=options.threads,
            reward_type=options.reward_type,
            success_rule=options.success_rule,
            control_hz=loaded.control_hz or DEFAULT_CONTROL_HZ,
            disturbances=options.disturbances,
        )
    return simulation


def write_result(file: Path, data: bytes) -> None:
    """Write the result of a command to a file.

    Raises:
        CommandError: If the file cannot be written.
    """
    try:
        write_file(file, data)
    except OSError as error:
        raise CommandError(f'{file}: {error.strerror}') from None
