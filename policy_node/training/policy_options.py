"""The options of commands that run a policy, and the policy they name."""

from __future__ import annotations

import argparse

from msgs_spec.command_line import FormerOption, UsageError, complain
from msgs_spec.tasks import TASKS
from policy_node.policies.loading import POLICY_NAMES, load_policy
from policy_node.policies.policy import LoadedPolicy


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
        help='load a .zip of Stable-Baselines3, which runs the code in it',
    )


def load_chosen_policy(options: argparse.Namespace) -> LoadedPolicy:
    """Loads the policy that the options of `add_policy_options` name.

    Raises:
        UsageError: If there is none such; one line says why.
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
