"""Run jobs in this process, several processes or Ray; jobs wait for networks they start from."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import Any, Protocol, Self

from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    complain,
    complain_from_handler,
)
from node_runtime.signals import discard_unread_output, end_with_parent
from policy_node.training.configuration.flat import changed
from policy_node.training.runs.run import RunTakenError, lock_run, train_run
from policy_node.training.runs.training_state import TrainingError
from policy_node.training.studies.measures import measure_run
from policy_node.training.studies.store import add_run, holds, read_runs
from policy_node.training.studies.study import Job

_NAME = 'fetch_hand_sim benchmark'
LOG_FILE = 'log.txt'
# Seconds between two lines about each running job.
_STATUS_SECONDS = 600.0


# Exit status of a job that another process trains. Others are those of the shell: 0, 1, and 128 +
# number of the signal that stopped the job.
TAKEN = 4


class Place(Protocol):
    """A place where jobs run: this process, several processes or a Ray cluster."""

    limit: int
    """Largest number of jobs at once."""

    def start(self, job: Job) -> None:
        """Start a job; this method may return before or after the job has ended."""
        ...

    def wait(self) -> tuple[Job, int]:
        """Wait until one of the started jobs has ended; return it and its exit status."""
        ...


def is_finished(job: Job, report: Path) -> bool:
    """Return whether a job is trained and its measures are stored in the report folder."""
    return job.is_trained and holds(read_runs(report), job)


def run_jobs(
    jobs: Sequence[Job],
    place: Place,
    report: Path,
    when_finished: Callable[[], object],
) -> int:
    """Run all unfinished jobs; a job that starts from networks of another one runs after it.

    Args:
        jobs: All jobs, the most important first.
        place: The place where they run.
        when_finished: Called after each finished job to update the report. If it fails, the jobs
            continue.

    Returns:
        0 if all jobs finished, else 1. If a signal stopped a job, no further job starts, and the
        result is 128 + the number of the signal.
    """
    waiting = [job for job in jobs if not is_finished(job, report)]
    running, left, stopped = 0, len(waiting), 0
    while True:
        ready = [] if stopped else [job for job in waiting if job.is_ready]
        for job in ready[: place.limit - running]:
            _print(f'job {jobs.index(job) + 1} of {len(jobs)}: {job.name}')
            waiting.remove(job)
            place.start(job)
            running += 1
        if running == 0:
            return stopped or (EXIT_FAILURE if left else EXIT_SUCCESS)
        job, status = place.wait()
        running -= 1
        if status > 128:
            stopped = stopped or status
        elif status == EXIT_SUCCESS:
            left -= 1
            _print(f'{job.name} is finished; {left} to go')
            try:
                when_finished()
            except (CommandError, OSError, ValueError) as error:
                complain(_NAME, f'no report yet: {error}')


def _print(text: str) -> None:
    """Print progress; a closed pipe does not end the jobs."""
    discard_unread_output()
    print(text, flush=True)


def attempt(job: Job, report: Path, command: str) -> int:
    """Train or continue a job; store its measures in the folder `report`; return a status.

    `command` is the command line, which is stored with the measures.
    The status is 0, 1 (error), `TAKEN` (another process trains it) or 128 + number of a signal.
    """
    try:
        # Another process may have finished the job meanwhile.
        if is_finished(job, report):
            return EXIT_SUCCESS
        if not job.is_trained:
            resume = job.has_checkpoint
            ending = train_run(job.config, job.folder, resume=resume, command=command)
            if ending.signal:
                return 128 + ending.signal
            if not job.is_trained:
                raise CommandError(f'training ended before the last step: {ending.reason}')
        with lock_run(job.folder):
            if not is_finished(job, report):
                add_run(report, measure_run(job, command))
    except RunTakenError:
        _print(f'{job.name} is being trained by another process')
        return TAKEN
    except (CommandError, TrainingError, OSError, ValueError) as error:
        complain(_NAME, f'{job.name}: {error}')
        return EXIT_FAILURE
    except Exception:
        # The other jobs go on.
        traceback.print_exc()
        return EXIT_FAILURE
    return EXIT_SUCCESS


class ThisProcess:
    """Place that runs one job after the other in this process."""

    def __init__(self, report: Path, command: str) -> None:
        self.limit = 1
        self._report, self._command = report, command
        self._ended: list[tuple[Job, int]] = []

    def start(self, job: Job) -> None:
        """Run the job to its end."""
        self._ended.append((job, attempt(job, self._report, self._command)))

    def wait(self) -> tuple[Job, int]:
        """Return the job that `start` has run, and its exit status."""
        return self._ended.pop()


class Processes:
    """Runs several jobs at once on this machine, each in a process that prints to its `log.txt`.

    As a context manager, it passes Ctrl-C and SIGTERM on to the processes as SIGTERM. They then
    finish their training cycle and save their state, as they do if this process is killed. A second
    signal ends them at once.
    """

    def __init__(self, limit: int, report: Path, command: str) -> None:
        self.limit = limit
        self._report, self._command = report, command
        self._running: dict[int, tuple[Job, BaseProcess]] = {}
        self._stopped_by = 0
        self._handlers: dict[int, Any] = {}

    def __enter__(self) -> Self:
        for number in (signal.SIGINT, signal.SIGTERM):
            self._handlers[number] = signal.signal(number, self._stop)
        return self

    def __exit__(self, *exception: object) -> None:
        processes = [process for _, process in self._running.values()]
        for process in processes:
            process.terminate()
        for process in processes:
            process.join()
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    def _stop(self, number: int, frame: FrameType | None) -> None:
        del frame
        if not self._stopped_by:
            text = 'stopping; jobs finish their cycle and save their state; once more stops at once'
            complain_from_handler(_NAME, text)
            self._stopped_by = number
        for _, process in self._running.values():
            process.terminate()

    def start(self, job: Job) -> None:
        """Start a process for the job."""
        context = multiprocessing.get_context('spawn')
        process = context.Process(target=_work, args=(job, self._report, self._command))
        process.start()
        self._running[process.sentinel] = job, process
        if self._stopped_by:
            process.terminate()

    def wait(self) -> tuple[Job, int]:
        """Wait until a process has ended; return its job and exit status."""
        while not (ended := wait(list(self._running), timeout=_STATUS_SECONDS)):
            for job, _ in self._running.values():
                _print(job.status)
        sentinel = ended[0]
        assert isinstance(sentinel, int)
        job, process = self._running.pop(sentinel)
        process.join()
        status = process.exitcode or EXIT_SUCCESS
        if status == -signal.SIGTERM:
            # Before the training installed its handler.
            status = 128 + signal.SIGTERM
        if status > 128 and self._stopped_by:
            # Every signal was passed on as SIGTERM.
            status = 128 + self._stopped_by
        if status == TAKEN:
            _print(f'{job.name} is being trained by another process')
        elif status != EXIT_SUCCESS and status < 128:
            complain(_NAME, f'{job.name} failed; see {job.folder / LOG_FILE}')
        return job, status


def _work(job: Job, report: Path, command: str) -> None:
    """Call `attempt` in a process of `Processes`, print to `log.txt`, and exit with the status."""
    # In the group of the parent, Ctrl-C would arrive twice. The session stays the same: Linux
    # schedules by session, so `nice` would have no effect in another.
    os.setpgid(0, 0)
    parent = multiprocessing.parent_process()
    if parent is not None and parent.pid is not None:
        end_with_parent(parent.pid)
    job.folder.mkdir(parents=True, exist_ok=True)
    with (job.folder / LOG_FILE).open('a') as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())
    sys.exit(attempt(job, report, command))


class Ray:
    """Place that runs as many jobs as a Ray cluster has cores for.

    All machines of the cluster need access to the same folders.
    """

    def __init__(self, report: Path, command: str) -> None:
        import ray

        ray.init(ignore_reinit_error=True, log_to_driver=True)
        self._ray = ray
        self.limit = sys.maxsize
        self._report, self._command = report.resolve(), command
        self._attempt = ray.remote(max_retries=0)(attempt)
        self._running: dict[Any, Job] = {}

    def start(self, job: Job) -> None:
        """Submit the job to the cluster."""
        cores = max(job.config.simulation_threads, job.config.torch_threads, 1)
        config, start = job.config, job.config.init_from
        # Paths must hold in every working directory; shipped actors keep their names.
        if start and Path(start).exists():
            config = changed(config, init_from=str(Path(start).resolve()))
        absolute = dataclasses.replace(job, config=config, folder=job.folder.resolve())
        remote = self._attempt.options(num_cpus=cores)
        self._running[remote.remote(absolute, self._report, self._command)] = job

    def wait(self) -> tuple[Job, int]:
        """Wait until a job has ended; return it and its exit status."""
        (done, *_), _ = self._ray.wait(list(self._running))
        job = self._running.pop(done)
        try:
            return job, self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            complain(_NAME, f'{job.name}: {error}')
            return job, EXIT_FAILURE
