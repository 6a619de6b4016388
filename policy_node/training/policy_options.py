"""The options of commands that run a policy, and the policy they name."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.arguments import finite_numbers
from msgs_spec.tasks import (
    DEFAULT_CONTROL_HZ,
    REWARD_TYPES,
    SUCCESS_RULES,
    TASKS,
    task_spec,
)
from msgs_spec.text import one_line
from node_runtime.command_line import CommandError, FormerOption, UsageError, complain, whole_number
from policy_node.policies.loading import POLICY_NAMES, load_policy
from policy_node.policies.policy import LoadedPolicy, Observation


def add_policy_options(parser: argparse.ArgumentParser, former: str | None = None) -> None:
    """Adds `--policy`, `--task` and `--trust`.

    Args:
        parser: Gets them.
        former: What `--policy` was called in this command.
    """
    add = parser.add_argument
    add('--policy', default='', help=POLICY_NAMES)
    if former is not None:
        add(former, dest='policy', action=FormerOption, help=argparse.SUPPRESS)
    add('--task', choices=list(TASKS), metavar='TASK', help='default: the task of the policy')
    add(
        '--trust',
        action='store_true',
        help='load a .zip of Stable-Baselines3, or module:function, which runs the code in it',
    )


def add_batch_options(parser: argparse.ArgumentParser, num_envs: int, episodes: int = 1000) -> None:
    """Add `--episodes` and `--num-envs`, with these defaults, and `--threads`."""
    add, count = parser.add_argument, whole_number(1)
    add('--episodes', type=count, default=episodes, help=f'default: {episodes}')
    simulations = f'simulations in the batch; default: {num_envs}'
    add('--num-envs', type=count, default=num_envs, help=simulations)
    add('--threads', type=int, default=0, help='simulation threads; default: all cores')


def add_disturbances_option(parser: argparse.ArgumentParser) -> None:
    """Add `--disturbances`."""
    presets = 'none, mild, hardware, severe, scaled as in hardware*0.5, or a YAML file'
    help_text = f'of the robot: {presets}; default: none'
    parser.add_argument('--disturbances', default='none', help=help_text)


def add_reward_options(parser: argparse.ArgumentParser) -> None:
    """Adds `--success-rule` and `--reward-type`."""
    add = parser.add_argument
    add('--success-rule', choices=SUCCESS_RULES, default='gymnasium', help='of the reward')
    add('--reward-type', choices=REWARD_TYPES, default='sparse', help='of the return')


def load_chosen_policy(options: argparse.Namespace) -> LoadedPolicy:
    """Loads the policy that the options of `add_policy_options` name.

    Raises:
        UsageError: If the policy cannot be loaded.
    """
    name: str = options.policy
    if not name and options.task is None:
        raise UsageError(f'--policy is missing; allowed: {POLICY_NAMES}')
    if name.startswith('sb3:'):
        # Formerly sb3:<class>:<file.zip>; the file tells its class.
        name = name.split(':', 2)[-1]
        complain('--policy', f'sb3:<class>: is not needed any more; give {name} and --trust')
    try:
        return load_policy(name, options.task, trust=options.trust)
    except ValueError as error:
        raise UsageError(str(error)) from None


class CheckedPolicy:
    """A policy whose failures and invalid actions end a command with one line.

    Args:
        loaded: The policy.
        is_clipped: Accept actions beyond [-1, 1], because the caller clips them.
    """

    def __init__(self, loaded: LoadedPolicy, *, is_clipped: bool = False) -> None:
        self._loaded = loaded
        self._is_clipped = is_clipped
        self._size = task_spec(loaded.task).robot.action_size

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], Any]:
        """Asks the policy about a batch.

        Raises:
            CommandError: If it fails, or answers with something else than an action for each.
        """
        try:
            answer, state = self._loaded.predict(observation, state, episode_start, deterministic)
            shape = len(np.asarray(observation['observation'])), self._size
            actions = finite_numbers('actions', answer, shape, self._loaded.task)
            if not self._is_clipped and (np.abs(actions) > 1.0).any():
                raise ValueError(f'actions lie in [-1, 1], not at {np.abs(actions).max():g}')
        except Exception as error:
            # Libraries raise types of their own.
            kind = '' if isinstance(error, ValueError) else f'{type(error).__name__}: '
            raise CommandError(
                f'{self._loaded.description} fails: {kind}{one_line(error)}'
            ) from None
        return actions, state


def make_chosen_simulation(options: argparse.Namespace, loaded: LoadedPolicy) -> Simulation:
    """Return simulations for a policy, with the batch, reward and disturbances options.

    Raises:
        UsageError: If an option does not fit the policy.
    """
    try:
        return Simulation(
            loaded.task,
            num_envs=min(options.num_envs, options.episodes),
            num_threads=options.threads,
            reward_type=options.reward_type,
            success_rule=options.success_rule,
            control_hz=loaded.control_hz or DEFAULT_CONTROL_HZ,
            disturbances=options.disturbances,
        )
    except ValueError as error:
        raise UsageError(str(error)) from None


def require_writable(file: Path) -> None:
    """Makes the folder of a file that will be written, so that no work is done for nothing.

    Raises:
        UsageError: If it could not be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f'{file} cannot be written: {error.strerror}') from None
    if file.is_dir():
        raise UsageError(f'{file} cannot be written: it is a folder')
    needed = [file] if file.exists() else []
    # A regular file is replaced by the new one, which its folder must take.
    if not file.exists() or (file.is_file() and not file.is_symlink()):
        needed.append(file.parent)
    if not all(os.access(each, os.W_OK) for each in needed):
        raise UsageError(f'{file} cannot be written: it is read-only')
