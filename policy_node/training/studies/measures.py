"""Measures of a run, and statistics over the seeds of a variant."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from msgs_spec.arrays import Array
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from policy_node.policies import checkpoint
from policy_node.training.configuration.recipes import ticks_of_40_ms
from policy_node.training.evaluation import FIRST_SEED, evaluate, success_rate
from policy_node.training.machine import processor
from policy_node.training.research.registry import make_simulation
from policy_node.training.runs.run_folder import COMMAND_FILE, LATEST_FILE, PROGRESS_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.studies.study import Job, to_settings

GOOD_SUCCESS = 0.9
COMPARED = ('area', 'area_in_time', 'final_success')
"""Measures by which variants are compared."""
_CHANCE = 0.05
# Processor time is rounded to this.
_SHORTEST = 0.1
_MOST_SIMULATIONS = 64


@dataclass(frozen=True, slots=True)
class Curve:
    """The success of one run over its environment steps, evaluated without noise.

    Attributes:
        env_steps: Environment steps of 40 ms at each evaluation, (n,), ascending.
        success: Success rate at the last step in each evaluation, (n,).
    """

    env_steps: Array
    success: Array

    @classmethod
    def of(cls, run: Mapping[str, Any]) -> Curve:
        """Return the curve of a run, given as a line of `runs.jsonl`."""
        return cls(*np.array(run['curve'], np.float64).reshape(-1, 2).T)


def measure_run(job: Job, command: str) -> dict[str, Any]:
    """Evaluate a trained job on fresh episodes; return its results as a line of `runs.jsonl`.

    `steps_to_0.9` is the number of steps of 40 ms until an evaluation first reached a success rate
    of 0.9, or None. `parts` counts how often the run was started. A resumed run (`parts` > 1) has
    other training episodes than an uninterrupted one. `command` is only recorded.

    Raises:
        ValueError: If the log has no evaluation or a file of the run is damaged.
    """
    config, rows = job.config, read_progress(job.folder / PROGRESS_FILE)
    ticks = ticks_of_40_ms(config.control_hz)
    points = [
        (row['env_steps'] / ticks, row['eval_success']) for row in rows if 'eval_success' in row
    ]
    if not points:
        raise ValueError(
            f'{job.folder / PROGRESS_FILE} contains no evaluation. '
            f'Remove {job.folder} to train it again.'
        )
    last, curve = rows[-1], Curve(*np.array(points).T)
    seconds = last['processor_seconds']
    return {
        'task': config.task,
        'arm': job.arm.name,
        'seed': config.seed,
        'env_steps': int(last['env_steps']),
        'simulated_seconds': round(last['env_steps'] / config.control_hz, 2),
        'area': round(area_under(curve, round(config.total_steps / ticks)), 4),
        f'steps_to_{GOOD_SUCCESS}': next((int(n) for n, s in points if s >= GOOD_SUCCESS), None),
        'final_success': _final_success(job),
        'final_episodes': job.final_episodes,
        'updates': int(last['updates']),
        'seconds': round(last['seconds'], 1),
        'processor_seconds': round(seconds, 1),
        'samples_per_processor_second': round(last['updates'] * config.batch_size / seconds, 1),
        'last_mean_value': last.get('mean_value'),
        'parts': len((job.folder / COMMAND_FILE).read_text().splitlines()),
        'machine': f'{processor()}, {os.cpu_count()} cores',
        'revision': checkpoint.read_info(job.folder / LATEST_FILE).source_revision,
        'curve': [[int(steps), float(f'{success:.6g}')] for steps, success in points],
        'command': command,
        'config': to_settings(config),
    }


def _final_success(job: Job) -> float | None:
    """Return the success rate of the last actor on `final_episodes` new episodes; None for 0.

    All jobs are measured on the same seeds, which training and its evaluations never use.
    """
    episodes, config = job.final_episodes, job.config
    if not episodes:
        return None
    actor, _ = checkpoint.load(job.folder / LATEST_FILE)
    count, threads = min(episodes, _MOST_SIMULATIONS), config.simulation_threads
    outcomes = evaluate(make_simulation(config, count, threads), actor, episodes, FIRST_SEED)
    return success_rate(outcomes, config.success_rule)


def area_under(curve: Curve, total_steps: int) -> float:
    """Return the mean success from step 0 to `total_steps`, interpolated between evaluations.

    Success rises linearly from 0 to the first evaluation and is constant after the last one. An
    evaluation beyond `total_steps` has no effect.
    """
    inside = curve.env_steps <= total_steps
    return _mean_until(float(total_steps), curve.env_steps[inside], curve.success[inside])


def area_in_time(run: Mapping[str, Any], seconds: float) -> float:
    """Return the mean success over the first `seconds` of CPU time of a line of `runs.jsonl`.

    All steps are assumed to cost the same. After the end of a run, its last success counts.
    """
    curve = Curve.of(run)
    share = max(seconds, _SHORTEST) / max(run['processor_seconds'], _SHORTEST)
    steps = run['simulated_seconds'] * DEFAULT_CONTROL_HZ
    return _mean_until(share * steps, curve.env_steps, curve.success)


def _mean_until(end: float, env_steps: Array, success: Array) -> float:
    known = np.concatenate([[0.0], env_steps]), np.concatenate([[0.0], success])
    steps = np.concatenate([[0.0], env_steps[env_steps < end], [end]])
    return float(np.trapezoid(np.interp(steps, *known), steps) / end)


def sum_up(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return medians and quartiles over the seeds of one variant: one row of `arms.csv`.

    Args:
        runs: Lines of `runs.jsonl` of the variant, with `area_in_time` added. `area_in_time` is
            None if the baseline has no run on the same machine. Measures of time exclude such
            runs; the column `timed` counts the included ones.
    """
    first, name_of_steps = runs[0], f'steps_to_{GOOD_SUCCESS}'
    timed = [run for run in runs if run['area_in_time'] is not None]
    found = {'task': first['task'], 'arm': first['arm'], 'seeds': len(runs), 'timed': len(timed)}
    for name in ('area', 'final_success'):
        known = [float(run[name]) for run in runs if run[name] is not None]
        found |= _quartiles(name, known)
    for name in ('processor_seconds', 'area_in_time', 'samples_per_processor_second'):
        found |= _quartiles(name, [float(run[name]) for run in timed])
    # A censored run counts as slower than any other.
    reached = [run[name_of_steps] for run in runs if run[name_of_steps] is not None]
    steps = [*map(float, reached), *[float('inf')] * (len(runs) - len(reached))]
    middle = np.median(steps)
    found[f'{name_of_steps}_median'] = int(middle) if np.isfinite(middle) else ''
    found['reached'] = len(reached)
    return found


def _quartiles(name: str, values: Sequence[float]) -> dict[str, float | str]:
    """Return quartiles and median as `<name>_lower`, `_median`, `_upper`; '' without values."""
    parts = ('lower', 'median', 'upper')
    if not values:
        return {f'{name}_{part}': '' for part in parts}
    quartiles = np.percentile(values, [25, 50, 75])
    return {f'{name}_{part}': round(float(q), 4) for part, q in zip(parts, quartiles, strict=True)}


def is_significant(arm: Mapping[str, Any], baseline: Mapping[str, Any], name: str) -> bool:
    """Return whether two variants, rows of `arms.csv`, differ in the measure `name`.

    They differ if their quartile ranges are disjoint and p <= 0.05. Disjoint ranges alone are too
    weak: equal variants of five seeds have them in 52 of the 252 possible orders.
    """
    below = arm[f'{name}_upper'] < baseline[f'{name}_lower']
    above = baseline[f'{name}_upper'] < arm[f'{name}_lower']
    return bool(below or above) and arm[f'{name}_p'] <= _CHANCE


def compared(
    runs: Sequence[Mapping[str, Any]], baseline: Sequence[Mapping[str, Any]]
) -> dict[str, float | str]:
    """Return rank-sum p-values of `runs` against `baseline` by `<measure>_p`; '' without values."""
    found: dict[str, float | str] = {}
    for name in COMPARED:
        first, second = (
            [float(run[name]) for run in group if run[name] is not None]
            for group in (runs, baseline)
        )
        is_known = first and second
        found[f'{name}_p'] = float(f'{rank_sum_chance(first, second):.4g}') if is_known else ''
    return found


def rank_sum_chance(first: Sequence[float], second: Sequence[float]) -> float:
    """Return the two-sided p-value of the exact rank-sum test (Wilcoxon 1945), with ties."""
    values = np.concatenate([first, second])
    # Twice the mid-ranks: whole numbers.
    ranks = 2 * (values[:, None] > values).sum(axis=1) + (values[:, None] == values).sum(axis=1) + 1
    count, total = len(first), int(ranks.sum())
    # ways[n, s]: number of choices of n values whose ranks sum to s.
    ways = np.zeros((count + 1, total + 1))
    ways[0, 0] = 1.0
    for rank in ranks.tolist():
        ways[1:, rank:] += ways[:-1, : total + 1 - rank]
    middle = total * count / len(values)
    as_far = np.abs(np.arange(total + 1) - middle) >= abs(ranks[:count].sum() - middle) - 1e-9
    return float(ways[count, as_far].sum() / ways[count].sum())
