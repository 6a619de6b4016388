"""Runs that another study has already: equal settings give equal runs, so none is made twice."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from fetch_hand_sim.datasets.writing import alone_in
from policy_node.policies.files import write_files
from policy_node.training.runs.run_folder import STATE_FILE
from policy_node.training.runs.training_state import read_state
from policy_node.training.studies.jobs import Job, differing_runs, run_name
from policy_node.training.studies.stored_runs import ABOUT, StoredRuns, run_of
from policy_node.training.studies.study import Study


def take_from_other_studies(jobs: Sequence[Job], studies: Path) -> None:
    """Copies finished runs of other studies into the folders of jobs that are configured alike.

    A copy keeps the command, the revision and the processor time of the run it is of.

    Args:
        jobs: Jobs of a study; those that have begun are left alone.
        studies: Folder of all studies, each with `<task>/<arm>/seed<k>`.
    """
    for job in jobs:
        if job.folder.exists() or (found := _equal_run(job, studies)) is None:
            continue
        # Whole or not there, and a copy of several that another process makes at the same time.
        copy = job.folder.with_name(f'.{job.folder.name}.{os.getpid()}')
        shutil.copytree(found, copy)
        try:
            copy.rename(job.folder)
        except OSError:
            shutil.rmtree(copy)
        else:
            print(f'{job.name} is the run in {found}', flush=True)


def take_from_other_reports(study: Study, jobs: Sequence[Job], report: Path) -> None:
    """Copies rows of runs that reports beside this one have of jobs that are configured alike.

    So a run of another machine, which is not among the runs here, is not made twice either. A row
    keeps machine, revision and processor time.

    Args:
        study: The study of the jobs.
        jobs: Its jobs; those that its report holds, or that have begun, are left alone.
        report: Its report, among those of the other studies.
    """
    with alone_in(report):
        stored, others = StoredRuns.read(report), _reports_beside(report)
        for job in jobs:
            if job.folder.exists() or stored.holds(job):
                continue
            for other in others:
                if (run := other.equal_run(job)) is not None:
                    curve = [row for row in other.curves if run_of(row) == run_of(run)]
                    name = f'{run_name(*run_of(run))} of {other.folder}'
                    stored.put(job, run, curve, f'as {name}')
                    write_files(stored.files(study))
                    print(f'{job.name} is {name}', flush=True)
                    break


def _reports_beside(report: Path) -> list[StoredRuns]:
    folders = [path.parent for path in sorted(report.parent.glob(f'*/{ABOUT}'))]
    return [StoredRuns.read(folder) for folder in folders if folder != report]


def _equal_run(job: Job, studies: Path) -> Path | None:
    """A finished run of any study with the settings of a job."""
    pattern = f'*/{job.config.task}/*/seed{job.config.seed}/{STATE_FILE}'
    for state in sorted(studies.glob(pattern)):
        there = Job(job.arm, job.config, state.parent, final_episodes=job.final_episodes)
        try:
            differing = differing_runs(read_state(state).extra['config'], job.config)
        except (ValueError, TypeError, OSError):
            continue
        if not differing and there.is_finished:
            return state.parent
    return None
