"""`benchmark`: the paper's comparison, DDPG with and without HER on sparse and dense rewards.

Trains task x arm x seed, each in <output>/<task>/<arm>/seed<k>, then draws success against steps
and prints a table beside the published numbers. Finished jobs are skipped and interrupted ones
continued, so the same command goes on where it stopped; given twice at once, it shares the work.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from msgs_spec.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    UsageError,
    require_extra,
    run_command,
)
from msgs_spec.tasks import TASKS
from policy_node.training.benchmark.jobs import (
    ARMS,
    Job,
    JobError,
    JobTakenError,
    list_jobs,
    run_job,
)
from policy_node.training.benchmark.results import write_report
from policy_node.training.learning.config import RECIPES, parse_assignment, recipe_config

_NAME = 'benchmark'


def reduced_budget(task: str) -> dict[str, Any]:
    """What makes the `paper` recipe fit one machine; everything else stays as in the paper.

    Two collections of 38 episodes are one, with twice the updates. Steps are 1.2 % (FetchReach) or
    12 % of the paper's; batches 256 or 1024 instead of 4864; to learn in so few updates, targets
    move after every 10 of them instead of 40.
    """
    small = task == 'FetchReach'
    full = recipe_config(task, 'paper').total_steps
    return {
        'total_steps': full * 12 // (1000 if small else 100),
        'num_envs': 76,
        'updates_per_cycle': 80,
        'batch_size': 256 if small else 1024,
        'target_update_interval': 10,
        'replay_transitions': 1_000_000,
        'evaluate_every': 3_800 if small else 19_000,
        # As many as there are simulations, so that none of them is cut short.
        'evaluation_episodes': 76,
    }


def parse_arguments(arguments: Sequence[str] | None) -> argparse.Namespace:
    """Parses the command line."""
    parser = argparse.ArgumentParser(prog=_NAME, description=__doc__)
    add = parser.add_argument
    add('--tasks', nargs='+', choices=list(TASKS), default=['FetchReach'], metavar='TASK')
    add('--arms', nargs='+', choices=list(ARMS), default=list(ARMS), metavar='ARM')
    add('--seeds', nargs='+', type=int, default=[0, 1, 2, 3, 4], metavar='SEED')
    add('--recipe', choices=RECIPES, default='paper', help='of all jobs; default: paper')
    add('--full', action='store_true', help="the recipe's own budget instead of the reduced one")
    add('--steps', type=int, help='environment steps of each job')
    add('--threads', type=int, help='simulation threads of each job')
    add('--torch-threads', type=int, help='tensor threads of each job')
    add('--set', action='append', default=[], metavar='NAME=VALUE', help='any field of TrainConfig')
    add('--output', type=Path, default=Path('runs/benchmark'), help='default: runs/benchmark')
    add('--report', type=Path, help='where figure and tables go; default: the output folder')
    add('--ray', action='store_true', help='independent jobs on Ray (extra: cluster)')
    return parser.parse_args(arguments)


def jobs_from_arguments(options: argparse.Namespace) -> list[Job]:
    """Lists the jobs and checks them against what the folders hold.

    Raises:
        ValueError: If a value is not allowed or does not fit a run that is there.
    """
    chosen = {
        'total_steps': options.steps,
        'simulation_threads': options.threads,
        'torch_threads': options.torch_threads,
    }
    overrides = {name: value for name, value in chosen.items() if value is not None}
    overrides.update(parse_assignment(text) for text in options.set)
    for name in ('task', 'recipe', 'seed', 'reward_type'):
        if name in overrides:
            raise ValueError(f'--set {name} is not possible: jobs differ in it')
    if overrides.get('strategy') == 'none':
        raise ValueError('--set strategy=none is not possible: choose --arms')
    jobs = []
    for task in dict.fromkeys(options.tasks):
        reduced = {} if options.full or options.recipe != 'paper' else reduced_budget(task)
        values = {**reduced, **overrides}
        seeds, arms = dict.fromkeys(options.seeds), dict.fromkeys(options.arms)
        jobs += list_jobs([task], list(arms), list(seeds), options.recipe, values, options.output)
    for job in jobs:
        job.check_configuration()
    return jobs


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit status."""
    options = parse_arguments(arguments)
    command = shlex.join([_NAME, *(sys.argv[1:] if arguments is None else arguments)])
    return run_command(_NAME, lambda: _run(options, command))


def _run(options: argparse.Namespace, command: str) -> int:
    if options.ray:
        require_extra('cluster')
    try:
        jobs = jobs_from_arguments(options)
    except (ValueError, TypeError) as error:
        raise UsageError(str(error)) from None
    try:
        whole = (_run_on_ray if options.ray else _run_in_turn)(jobs, command)
        return EXIT_SUCCESS if whole else EXIT_FAILURE
    except JobError as error:
        raise CommandError(str(error)) from None
    finally:
        _report(options, jobs, command)


def _report(options: argparse.Namespace, jobs: Sequence[Job], command: str) -> None:
    """Draws and prints what is finished, and says what is not."""
    finished = [job for job in jobs if job.is_finished]
    if finished:
        write_report(finished, options.report or options.output, command)
    if len(finished) < len(jobs):
        print(f'{len(finished)} of {len(jobs)} jobs are finished; the same command goes on')


def _run_in_turn(jobs: Sequence[Job], command: str) -> bool:
    """Runs what is not finished; whether all is now."""
    whole = True
    for number, job in enumerate(jobs, 1):
        if job.is_finished:
            continue
        print(f'job {number} of {len(jobs)}: {job.name}', flush=True)
        try:
            if not run_job(job, command):
                # The trainer took the signal and finished its cycle.
                raise KeyboardInterrupt
        except JobTakenError as error:
            print(error)
            whole = False
    return whole


def _run_on_ray(jobs: Sequence[Job], command: str) -> bool:
    """Gives every job that is not finished to Ray; folders must lie where all its machines see."""
    import ray

    ray.init(ignore_reinit_error=True, log_to_driver=True)
    remote = ray.remote(max_retries=0)(run_job)
    waiting = {}
    for job in jobs:
        if not job.is_finished:
            config = job.config
            cores = max(config.simulation_threads + config.torch_threads, 1)
            waiting[remote.options(num_cpus=cores).remote(_with_absolute_folder(job), command)] = (
                job
            )
    whole = True
    while waiting:
        (done, *_), _ = ray.wait(list(waiting))
        job = waiting.pop(done)
        try:
            whole &= bool(ray.get(done))
        except ray.exceptions.RayTaskError as error:
            if isinstance(error.cause, JobTakenError):
                whole = False
                continue
            raise JobError(f'{job.name}: {error.cause}') from None
        print(f'{job.name} is finished; {len(waiting)} to go', flush=True)
    return whole


def _with_absolute_folder(job: Job) -> Job:
    return Job(job.arm, job.config, job.folder.resolve())
