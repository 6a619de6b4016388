"""`evaluate_reference`: measure the success of a policy in Gymnasium-Robotics (`is_success`).

On MuJoCo >= 3.17 an `assert` of that package fails, because it compares an enum with a NumPy
integer. So run without asserts: `python -O -m policy_node.training.evaluate_reference`.
"""

from __future__ import annotations

import argparse
import json
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.tasks import DEFAULT_CONTROL_HZ, task_spec
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandParser,
    UsageError,
    run_command,
    say,
    whole_number,
)
from policy_node.policies.files import require_writable, to_json
from policy_node.policies.policy import Policy
from policy_node.training.evaluation import wilson_interval
from policy_node.training.policy_options import (
    add_first_seed,
    add_policy_options,
    chosen_seeds,
    load_chosen_policy,
    policy_errors,
    write_result,
)


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog='evaluate_reference', description=__doc__)
    add_policy_options(parser)
    add_first_seed(parser)
    add = parser.add_argument
    add('--episodes', type=whole_number(1), default=1000, help='default: 1000')
    add('--json', type=Path, help='add the result to this JSON file')
    return parser.parse_args(arguments)


def success_in_reference(
    policy: Policy, reference_id: str, ticks: int, seeds: Sequence[int]
) -> int:
    """Run one episode per seed in Gymnasium-Robotics; return how many end in success.

    Each episode of a task with an object in the hand gets a new environment, because
    Gymnasium-Robotics carries state over from one episode to the next.

    Args:
        reference_id: Environment of Gymnasium-Robotics, for example `FetchPush-v4`.
        ticks: Steps per episode.
    """
    warnings.filterwarnings('ignore')
    import gymnasium
    import gymnasium_robotics

    gymnasium.register_envs(gymnasium_robotics)
    successes = 0
    env = gymnasium.make(reference_id)
    for number, seed in enumerate(seeds):
        if number and reference_id.startswith('HandManipulate'):
            env.close()
            env = gymnasium.make(reference_id)
        observation, _ = env.reset(seed=seed)
        info: dict[str, Any] = {}
        state = None
        for _ in range(ticks):
            action, state = policy.predict(observation, state, deterministic=True)
            observation, _, _, _, info = env.step(action)
        successes += bool(info['is_success'])
    env.close()
    return successes


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    options = parse_arguments(arguments)
    return run_command('evaluate_reference', lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    if __debug__:
        raise UsageError('asserts are enabled; start with python -O')
    loaded = load_chosen_policy(options)
    spec = task_spec(loaded.task)
    if loaded.control_hz not in (None, DEFAULT_CONTROL_HZ):
        raise UsageError(f'{loaded.description} was trained at {loaded.control_hz:g} Hz, not at 25')
    seeds = chosen_seeds(options)
    if spec.reference_id is None:
        raise UsageError(f'{spec.name} is no task of Gymnasium-Robotics')
    report = _report_to_add_to(options.json)
    with policy_errors():
        successes = success_in_reference(loaded, spec.reference_id, spec.episode_ticks, seeds)
    lower, upper = wilson_interval(successes, options.episodes)
    result = {
        'environment': spec.reference_id,
        'episodes': options.episodes,
        'first_seed': options.first_seed,
        'success': successes / options.episodes,
        'interval_95': [lower, upper],
    }
    try:
        say(f'{spec.reference_id}: {result["success"]:.4f} ({lower:.4f} ... {upper:.4f})')
    finally:
        # Also if the terminal was closed.
        if options.json is not None:
            write_result(options.json, to_json({**report, 'reference': result}))
    return EXIT_SUCCESS


def _report_to_add_to(file: Path | None) -> dict[str, Any]:
    """Return the JSON object in `file`; empty if there is no such file.

    This is called before the long evaluation, so that an unusable file is found early.

    Raises:
        UsageError: If the file cannot be written or contains no JSON object.
    """
    if file is None:
        return {}
    require_writable(file)
    try:
        report = json.loads(file.read_text()) if file.is_file() else {}
    except ValueError as error:
        raise UsageError(f'{file} is no JSON: {error}') from None
    if not isinstance(report, dict):
        raise UsageError(f'{file} contains no JSON object, so no result can be added')
    return report


if __name__ == '__main__':
    sys.exit(main())
