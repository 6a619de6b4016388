"""Reports of jobs: all that is finished, or one line that says which job cannot be told of."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path

from msgs_spec.tasks import task_spec
from node_runtime.command_line import CommandError, complain
from policy_node.policies.checkpoint import read_info
from policy_node.training.runs.run_folder import BEST_FILE, LATEST_FILE, PROGRESS_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.shipping import ship
from policy_node.training.studies.jobs import Job
from policy_node.training.studies.measures import curve_of, measure_run
from policy_node.training.studies.research_report import write_study
from policy_node.training.studies.results import write_report
from policy_node.training.studies.stored_runs import RUNS
from policy_node.training.studies.study import Study


def report(jobs: Sequence[Job], study: Study | None, output: Path, command: str) -> None:
    """Writes what finished jobs gave; where none is finished, a study's page from what it holds.

    Args:
        jobs: Finished jobs.
        study: The study of `docs/research`; None is the paper's comparison, or `best`.
        output: Folder.
        command: Command line, for the record.

    Raises:
        CommandError: If a job's files are damaged, since a report without it would lose what an
            earlier one tells of it; or if the report cannot be written.
    """
    require_readable(jobs)
    try:
        if study is not None and (jobs or (output / RUNS).is_file()):
            write_study(study, jobs, output, command)
        elif jobs:
            write_report(jobs, output, command)
    except (OSError, ValueError) as error:
        raise CommandError(f'no report in {output}: {error}') from None


def require_readable(jobs: Sequence[Job]) -> None:
    """Refuses finished jobs that no report can tell of.

    Raises:
        CommandError: If there is one; the line says why, and what to do.
    """
    for job in jobs:
        why = _damage(job)
        if why:
            raise CommandError(f'{job.name}: {why}; without {job.folder} it is run again')


def _damage(job: Job) -> str:
    """Why a report could not tell of a finished job; empty if it can."""
    try:
        curve = curve_of(job)
        read_info(job.folder / LATEST_FILE)
        if job.final_episodes:
            measure_run(job, curve)
        if (lost := _lost_rows(job)) is not None:
            return f'{PROGRESS_FILE} lacks rows from {lost:,.0f} steps on'
    except KeyError as error:
        return f'its files lack {error}'
    except (OSError, ValueError) as error:
        return str(error)
    return ''


def _lost_rows(job: Job) -> float | None:
    """After which step the log of a finished job has lost rows, of which each cycle has one.

    A cycle is shorter where MuJoCo gave episodes up, which are not counted.
    """
    config = job.config
    cycle = config.num_envs * task_spec(config.task, control_hz=config.control_hz).episode_ticks
    steps = [0.0, *(row['env_steps'] for row in read_progress(job.folder / PROGRESS_FILE))]
    for before, after in itertools.pairwise(steps):
        if after > before + cycle:
            return before
    return steps[-1] if steps[-1] < config.total_steps else None


def ship_all(jobs: Sequence[Job], actors: Path, episodes: int) -> bool:
    """Evaluates best actors that were not evaluated before, and keeps the better ones.

    Returns:
        Whether none of them was in the way of that.
    """
    whole = True
    for job in jobs:
        if not (job.folder / BEST_FILE).is_file():
            complain('benchmark', f'{job.name} has no best actor: no evaluation was whole')
            continue
        try:
            ship(job.folder, actors, episodes=episodes)
        except (OSError, ValueError, CommandError) as error:
            complain('benchmark', f'{job.name} is not shipped: {error}')
            whole = False
    return whole
