"""What a study measures of a run, and how runs of one arm are summed up."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from msgs_spec.arrays import Array
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from policy_node.policies.checkpoint import read_info
from policy_node.training.configuration.recipes import ticks_of_40_ms
from policy_node.training.runs.run_folder import COMMAND_FILE, LATEST_FILE, PROGRESS_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.studies.final import read_final
from policy_node.training.studies.jobs import Job
from policy_node.training.studies.machines import machine
from policy_node.training.studies.results import Curve, read_curve

GOOD_SUCCESS = 0.9
_SUMMED_UP = ('area', 'final_success')
MEASURED = (
    'task',
    'arm',
    'seed',
    'env_steps',
    'simulated_seconds',
    'area',
    f'steps_to_{GOOD_SUCCESS}',
    'final_success',
    'final_episodes',
    'updates',
    'seconds',
    'processor_seconds',
    'samples_per_processor_second',
    'last_mean_value',
    'parts',
    'machine',
    'revision',
)
"""Columns of `runs.csv`."""
COMPARED = ('area', 'area_in_time', 'final_success')
"""What arms are compared by."""
_CHANCE = 0.05
# What can be compared on machines alone where the baseline ran too.
_SUMMED_UP_IN_TIME = ('processor_seconds', 'area_in_time', 'samples_per_processor_second')
# Processor time is rounded to this.
_SHORTEST = 0.1


def area_under(curve: Curve, total_steps: int) -> float:
    """Mean success from the first step to `total_steps`, between evaluations on straight lines.

    Before the first evaluation it rises from 0; after the last it stays.
    """
    inside = curve.env_steps <= total_steps
    return _mean_until(float(total_steps), curve.env_steps[inside], curve.success[inside])


def area_in_time(curve: Curve, run: Mapping[str, Any], seconds: float) -> float:
    """Mean success over the first `seconds` of processor time of a run.

    Its steps are taken to cost the same from first to last. A run that took less stays where it
    ended.

    Args:
        curve: Its evaluations, steps in units of 40 ms.
        run: Its row of `runs.csv`.
        seconds: Processor time.
    """
    share = max(seconds, _SHORTEST) / max(run['processor_seconds'], _SHORTEST)
    # Beyond the last evaluation too: its time is that of the whole run.
    steps = run['simulated_seconds'] * DEFAULT_CONTROL_HZ
    return _mean_until(share * steps, curve.env_steps, curve.success)


def _mean_until(end: float, env_steps: Array, success: Array) -> float:
    """Mean success over the first `end` steps: from 0 on straight lines, at last as it was."""
    known = np.concatenate([[0.0], env_steps]), np.concatenate([[0.0], success])
    steps = np.concatenate([[0.0], env_steps[env_steps < end], [end]])
    return float(np.trapezoid(np.interp(steps, *known), steps) / end)


def curve_of(job: Job) -> Curve:
    """Evaluations of a run, steps in units of 40 ms."""
    curve = read_curve(job.folder / PROGRESS_FILE)
    return replace(curve, env_steps=curve.env_steps / ticks_of_40_ms(job.config.control_hz))


def measure_run(job: Job, curve: Curve) -> dict[str, Any]:
    """One row of `runs.csv`.

    Steps to success are empty where no evaluation got there: the run is censored at its budget.
    `parts` counts how often the run was started: more than one is no longer the same to the bit.

    Args:
        job: A finished job.
        curve: Its evaluations, steps in units of 40 ms.
    """
    final, last = read_final(job.folder) or {}, read_progress(job.folder / PROGRESS_FILE)[-1]
    reached = curve.steps_to(GOOD_SUCCESS)
    total = round(job.config.total_steps / ticks_of_40_ms(job.config.control_hz))
    samples = last['updates'] * job.config.batch_size
    processor_seconds = last['processor_seconds']
    return {
        'task': job.config.task,
        'arm': job.arm.name,
        'seed': job.config.seed,
        'env_steps': int(last['env_steps']),
        'simulated_seconds': round(last['env_steps'] / job.config.control_hz, 2),
        'area': round(area_under(curve, total), 4),
        f'steps_to_{GOOD_SUCCESS}': int(reached) if np.isfinite(reached) else '',
        'final_success': final['success'],
        'final_episodes': final['episodes'],
        'updates': int(last['updates']),
        'seconds': round(last['seconds'], 1),
        'processor_seconds': round(processor_seconds, 1),
        'samples_per_processor_second': round(samples / processor_seconds, 1),
        'last_mean_value': last.get('mean_value', ''),
        'parts': len((job.folder / COMMAND_FILE).read_text().splitlines()),
        # Runs of before do not say where they ran: here.
        'machine': final.get('machine', machine()),
        'revision': read_info(job.folder / LATEST_FILE).source_revision,
    }


def sum_up(runs: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Medians and quartiles over the seeds of one arm: one row of `arms.csv`.

    Args:
        runs: Rows of `runs.csv`, each with its `area_in_time`: None where its processor time has
            nothing to be compared with. Medians of time are those of the others, whose number is
            `timed`; empty where there are none.
    """
    first, reached = runs[0], [run[f'steps_to_{GOOD_SUCCESS}'] for run in runs]
    timed = [run for run in runs if run['area_in_time'] is not None]
    found = {'task': first['task'], 'arm': first['arm'], 'seeds': len(runs), 'timed': len(timed)}
    for names, group in ((_SUMMED_UP, runs), (_SUMMED_UP_IN_TIME, timed)):
        for name in names:
            found |= _quartiles(name, [float(run[name]) for run in group])
    # A censored run counts as slower than any other, and as one of the two in the middle it leaves
    # no mean of them.
    middle = np.median([float('inf') if steps == '' else float(steps) for steps in reached])
    found[f'steps_to_{GOOD_SUCCESS}_median'] = '' if np.isinf(middle) else int(middle)
    found['reached'] = sum(steps != '' for steps in reached)
    return found


def _quartiles(name: str, values: Sequence[float]) -> dict[str, float | str]:
    """Median and quartiles under names of their own; of no values empty."""
    parts = ('lower', 'median', 'upper')
    if not values:
        return {f'{name}_{part}': '' for part in parts}
    quartiles = np.percentile(values, [25, 50, 75])
    return {f'{name}_{part}': round(float(q), 4) for part, q in zip(parts, quartiles, strict=True)}


def are_apart(arm: Mapping[str, Any], baseline: Mapping[str, Any], name: str) -> bool:
    """Whether two arms of five seeds differ: quartiles do not touch, and that is seldom by chance.

    Quartiles alone are too easy to part: of two equal arms of five seeds they do so in 52 of the
    252 orders that there are.

    Args:
        arm: Its row of `arms.csv`, compared with the baseline.
        baseline: That of the baseline.
        name: What is compared.
    """
    below = arm[f'{name}_upper'] < baseline[f'{name}_lower']
    above = baseline[f'{name}_upper'] < arm[f'{name}_lower']
    return bool(below or above) and arm[f'{name}_p'] <= _CHANCE


def compared(
    runs: Sequence[Mapping[str, Any]], baseline: Sequence[Mapping[str, Any]]
) -> dict[str, float | str]:
    """By what chance two equal arms would lie as far apart, `<name>_p`; empty without runs.

    Args:
        runs: Rows of `runs.csv`, each with its `area_in_time`.
        baseline: Those of the first arm; none for itself.
    """
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
    """Two-sided p of the exact rank-sum test (Wilcoxon 1945): by permutation, ties with mid-ranks.

    Args:
        first: Values of one arm.
        second: Those of the other.
    """
    values = np.concatenate([first, second])
    # Twice the ranks, which ties share: whole numbers.
    ranks = 2 * (values[:, None] > values).sum(axis=1) + (values[:, None] == values).sum(axis=1) + 1
    count, total = len(first), int(ranks.sum())
    # In how many ways so many of them have each sum.
    ways = np.zeros((count + 1, total + 1))
    ways[0, 0] = 1.0
    for rank in ranks.tolist():
        ways[1:, rank:] += ways[:-1, : total + 1 - rank]
    middle = total * count / len(values)
    as_far = np.abs(np.arange(total + 1) - middle) >= abs(ranks[:count].sum() - middle) - 1e-9
    return float(ways[count, as_far].sum() / ways[count].sum())
