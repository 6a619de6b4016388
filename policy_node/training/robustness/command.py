"""Measure the success rate of a policy under up to ten disturbances and under the presets.

A point is the undisturbed robot, a preset or one of several levels of a disturbance. The result is
a JSON file, a CSV file and a figure. After an interruption, the same command evaluates only the
missing points.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from pathlib import Path
from typing import Any

from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import task_spec
from node_runtime.command_line import (
    EXIT_SUCCESS,
    CommandError,
    CommandParser,
    UsageError,
    complain,
    progress,
    run_command,
    say,
    whole_number,
)
from policy_node.policies.files import require_writable, to_csv, to_json
from policy_node.policies.policy import LoadedPolicy
from policy_node.training.evaluation import (
    evaluate,
    wilson_interval,
)
from policy_node.training.policy_options import (
    add_batch_options,
    add_first_seed,
    add_policy_options,
    load_chosen_policy,
    make_chosen_simulation,
    policy_errors,
    write_result,
)
from policy_node.training.robustness.figure import draw
from policy_node.training.robustness.sweeps import Point, points, sentence

_NAME = 'fetch_hand_sim robustness'
# Settings that make the points of two results comparable.
_SETTINGS = ('policy', 'task', 'sha256', 'episodes', 'first_seed', 'control_hz')


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = CommandParser(prog=_NAME, description=__doc__)
    add_policy_options(parser)
    add_batch_options(parser, num_envs=100, episodes=200)
    add_first_seed(parser)
    add = parser.add_argument
    add(
        '--output',
        type=Path,
        metavar='NAME',
        help='writes NAME.json, NAME.csv and NAME.png; default: <task>.robustness',
    )
    add('--jobs', type=whole_number(1), default=1, metavar='N', help='points at once; default: 1')
    parser.set_defaults(reward_type='sparse', success_rule='gymnasium', disturbances='none')
    return parser.parse_args(arguments)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; return its exit code."""
    options = parse_arguments(arguments)
    return run_command(_NAME, lambda: _run(options))


def _run(options: argparse.Namespace) -> int:
    loaded = load_chosen_policy(options)
    simulation = make_chosen_simulation(options, loaded)
    name = options.output or Path(f'{loaded.task}.robustness')
    name = name.with_suffix('') if name.suffix == '.json' else name
    if not name.name:
        raise UsageError(f'--output {name}; allowed: the path of a file')
    files = {kind: name.with_name(f'{name.name}.{kind}') for kind in ('json', 'csv', 'png')}
    for file in files.values():
        require_writable(file)
    result = _start(options, loaded, simulation, files['json'])
    with policy_errors():
        _measure(result, options, simulation, loaded, files['json'])
    success = {key: point['success'] for key, point in result['points'].items()}
    result['sentence'] = sentence(task_spec(loaded.task), result['control_hz'], success)
    write_result(files['json'], to_json(result))
    write_result(files['csv'], _to_csv(result))
    try:
        write_result(files['png'], draw(result))
    except ImportError:
        say(f'{files["png"]} needs matplotlib: pip install fetch_hand_sim[train]')
    say(result['sentence'])
    return EXIT_SUCCESS


def _start(
    options: argparse.Namespace, loaded: LoadedPolicy, simulation: Simulation, file: Path
) -> dict[str, Any]:
    """Return the settings of this evaluation; `points` are those that `file` already contains.

    Raises:
        UsageError: If `file` exists, but is not a result of this policy with the same settings.
    """
    result: dict[str, Any] = {
        'policy': Path(options.policy or loaded.task).name,
        'task': loaded.task,
        'sha256': loaded.sha256,
        'episodes': options.episodes,
        'first_seed': options.first_seed,
        'control_hz': simulation.control_hz,
        'points': {},
    }
    if not file.exists():
        return result
    try:
        earlier = json.loads(file.read_text())
        is_same = all(earlier[name] == result[name] for name in _SETTINGS)
        earlier_points = dict(earlier['points'])
    except (ValueError, LookupError, TypeError, RecursionError):
        raise UsageError(f'{file} is no result of this command; give another --output') from None
    if not is_same:
        raise UsageError(
            f'{file} is of another policy or has other settings ({", ".join(_SETTINGS)}); '
            'remove it or give another --output'
        )
    # A function has no hash, so its code may have changed.
    complain(_NAME, f'{file} has {len(earlier_points)} points; remove it to measure them again')
    return {**result, 'points': earlier_points}


# Options, simulation and policy of a worker process.
_worker: list[Any] = []


def _start_worker(options: argparse.Namespace) -> None:
    # Ctrl-C ends the worker at once and without a traceback.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    loaded = load_chosen_policy(options)
    _worker.extend((options, make_chosen_simulation(options, loaded), loaded))


def _measure_in_worker(point: Point) -> dict[str, Any]:
    options, simulation, loaded = _worker
    return _measured(options, simulation, loaded, point)


def _measured_in_workers(
    options: argparse.Namespace, missing: Sequence[Point]
) -> Iterator[dict[str, Any]]:
    """Evaluate points in `--jobs` processes; yield the result of `_measured` for each, in order."""
    jobs = min(options.jobs, len(missing))
    threads = options.threads or max(1, len(os.sched_getaffinity(0)) // jobs)
    own = argparse.Namespace(**{**vars(options), 'threads': threads})
    context = multiprocessing.get_context('spawn')
    pool = ProcessPoolExecutor(jobs, context, _start_worker, (own,))
    try:
        yield from pool.map(_measure_in_worker, missing)
    except BrokenProcessPool:
        raise CommandError('a process ended early, for example for lack of memory') from None
    finally:
        pool.shutdown(cancel_futures=True)


def _measure(
    result: dict[str, Any],
    options: argparse.Namespace,
    simulation: Simulation,
    loaded: LoadedPolicy,
    file: Path,
) -> None:
    """Evaluate each point that `result` lacks and add it; rewrite `file` after each."""
    missing = [each for each in points(simulation.spec) if each.key not in result['points']]
    if options.jobs > 1 and missing:
        found = _measured_in_workers(options, missing)
    else:
        found = (_measured(options, simulation, loaded, point) for point in missing)
    with progress('points', len(missing)) as advance:
        for point, measured in zip(missing, found, strict=True):
            result['points'][point.key] = measured
            write_result(file, to_json(result))
            advance(1)


def _measured(
    options: argparse.Namespace, simulation: Simulation, loaded: LoadedPolicy, point: Point
) -> dict[str, Any]:
    """Evaluate the policy at one point; return its entry of the JSON file with the success rate."""
    simulation.disturbances = point.disturbances
    bounded = replace(loaded, is_bounded=True)
    outcomes = evaluate(simulation, bounded, options.episodes, options.first_seed)
    count = int(outcomes.success_gymnasium.sum())
    return {
        'disturbance': point.name,
        'level': point.level,
        'success': count / len(outcomes),
        'success_interval_95': list(wilson_interval(count, len(outcomes))),
        'dropped': float(outcomes.dropped.mean()),
        'diverged': int(outcomes.diverged.sum()),
        'disturbances': point.disturbances.as_dict(),
    }


def _to_csv(result: dict[str, Any]) -> bytes:
    """Return a CSV file; each row has the name, level and success rate of one point."""
    before, after = ['disturbance', 'level', 'success'], ['dropped', 'diverged']
    rows = (
        [*(each[n] for n in before), *each['success_interval_95'], *(each[n] for n in after)]
        for each in result['points'].values()
    )
    return to_csv([*before, 'low_95', 'high_95', *after], rows)
