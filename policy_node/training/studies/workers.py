"""Where jobs run: in this process, in several of this machine, or on Ray; and in which order."""

from __future__ import annotations

import dataclasses
import multiprocessing
import os
import signal
import sys
import traceback
from collections.abc import Callable, Sequence
from contextlib import suppress
from enum import Enum
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
    discard_unread_output,
)
from node_runtime.parent_process import end_with_parent
from policy_node.training.runs.run import RunTakenError, lock_run, train_run
from policy_node.training.studies.final import measure_final
from policy_node.training.studies.jobs import Job

LOG_FILE = 'log.txt'
# Seconds between two lines about each running job.
_STATUS_SECONDS = 600.0


class Outcome(Enum):
    """What became of a job; the value is the exit status of its process."""

    FINISHED = EXIT_SUCCESS
    FAILED = EXIT_FAILURE
    TAKEN = 4
    # Stopped by a signal, as shells say it.
    HUNG_UP = 128 + signal.SIGHUP
    INTERRUPTED = 128 + signal.SIGINT
    TERMINATED = 128 + signal.SIGTERM

    @classmethod
    def stopped_by(cls, number: int) -> Outcome:
        """Returns what became of a job that this signal stopped."""
        return cls(128 + number)

    @property
    def is_stopped(self) -> bool:
        """Whether a signal stopped it."""
        return self.value > 128


class JobsStopped(KeyboardInterrupt):
    """A signal stopped jobs.

    Args:
        outcome: What became of the first.

    Attributes:
        exit_code: With which the command ends.
    """

    def __init__(self, outcome: Outcome) -> None:
        super().__init__()
        self.exit_code: int = outcome.value


class Place(Protocol):
    """Where jobs run."""

    limit: int
    """Most jobs at once."""

    def start(self, job: Job) -> None:
        """Starts a job; it may be over when this returns."""
        ...

    def wait(self) -> tuple[Job, Outcome]:
        """Waits until one of the started jobs is over."""
        ...


def run_jobs(
    jobs: Sequence[Job], place: Place, when_finished: Callable[[], object] | None = None
) -> bool:
    """Runs what is not finished, each job after the one it starts from; whether all is now.

    Args:
        jobs: All jobs, in the order of their importance.
        place: Where they run.
        when_finished: Called after each job that finished.

    Raises:
        JobsStopped: If a signal stopped a job; nothing else is started then.
    """
    waiting = [job for job in jobs if not job.is_finished]
    numbers = {job.name: number for number, job in enumerate(jobs, 1)}
    running, whole = 0, True
    stopped: Outcome | None = None
    while True:
        for job in [job for job in waiting if job.is_ready and not stopped]:
            if running < place.limit:
                _tell(f'job {numbers[job.name]} of {len(jobs)}: {job.name}')
                waiting.remove(job)
                place.start(job)
                running += 1
        if running == 0:
            break
        job, outcome = place.wait()
        running -= 1
        whole &= outcome is Outcome.FINISHED
        stopped = stopped or (outcome if outcome.is_stopped else None)
        if outcome is Outcome.FINISHED:
            left = sum(not other.is_finished for other in jobs)
            _tell(f'{job.name} is finished; {left} to go')
            if when_finished is not None:
                _report(when_finished)
    if stopped:
        raise JobsStopped(stopped)
    return whole and not waiting


def _report(when_finished: Callable[[], object]) -> None:
    """Says what is known so far; where that fails, what still runs is not ended for it."""
    try:
        when_finished()
    except (CommandError, OSError, ValueError) as error:
        complain('benchmark', f'no report yet: {error}')


def _tell(text: str) -> None:
    """Says how far jobs are; they do not end because nobody reads it any more."""
    discard_unread_output()
    print(text, flush=True)


def attempt(job: Job, command: str) -> Outcome:
    """Starts or continues a job in this process and says what goes wrong.

    Args:
        job: The job.
        command: Command line of the benchmark, for the record.
    """
    try:
        # By another process, since this one looked.
        if job.is_finished:
            return Outcome.FINISHED
        if not job.is_trained:
            resume = job.has_checkpoint
            ending = train_run(job.config, job.folder, resume=resume, command=command)
            if ending.signal:
                return Outcome.stopped_by(ending.signal)
            if not job.is_trained:
                raise CommandError(f'it ended before its steps were done: {ending.reason}')
        with lock_run(job.folder):
            if not job.is_finished:
                _measure(job)
    except RunTakenError:
        _tell(f'{job.name} is being run by another process')
        return Outcome.TAKEN
    except CommandError as error:
        # By another process, between a look and a lock.
        with suppress(ValueError):
            if job.is_finished:
                return Outcome.FINISHED
        complain('benchmark', f'{job.name}: {error}')
        return Outcome.FAILED
    except Exception:
        # Whatever it is, the other jobs go on.
        traceback.print_exc()
        return Outcome.FAILED
    return Outcome.FINISHED


def _measure(job: Job) -> None:
    """Measures the end of a job, where that is asked for.

    Raises:
        CommandError: If its actor is damaged, or there is no room for the result.
    """
    if job.final_episodes:
        try:
            measure_final(job.config, job.folder, job.final_episodes)
        except (OSError, ValueError) as error:
            raise CommandError(str(error)) from None


class ThisProcess:
    """One job after the other, here."""

    def __init__(self, command: str) -> None:
        self.limit = 1
        self._command = command
        self._over: list[tuple[Job, Outcome]] = []

    def start(self, job: Job) -> None:
        """Runs the job."""
        self._over.append((job, attempt(job, self._command)))

    def wait(self) -> tuple[Job, Outcome]:
        """The job that ran last."""
        return self._over.pop()


class Processes:
    """Several jobs at once, each in a process of its own that prints into `log.txt` of its run.

    Ctrl-C and SIGTERM reach them as SIGTERM: they finish their cycle and keep their state. So they
    do if this process is killed. A second signal ends them at once.
    """

    def __init__(self, limit: int, command: str) -> None:
        self.limit = limit
        self._command = command
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
            text = 'stopping; jobs finish their cycle and keep their state; once more stops at once'
            complain_from_handler('benchmark', text)
            self._stopped_by = number
        for _, process in self._running.values():
            process.terminate()

    def start(self, job: Job) -> None:
        """Starts a process for the job."""
        context = multiprocessing.get_context('spawn')
        process = context.Process(target=_work, args=(job, self._command))
        process.start()
        self._running[process.sentinel] = job, process
        if self._stopped_by:
            process.terminate()

    def wait(self) -> tuple[Job, Outcome]:
        """Waits for one of the processes."""
        while not (over := wait(list(self._running), timeout=_STATUS_SECONDS)):
            for job, _ in self._running.values():
                _tell(job.status)
        sentinel = over[0]
        assert isinstance(sentinel, int)
        job, process = self._running.pop(sentinel)
        process.join()
        # By the signal itself where it came before the trainer listened.
        codes = {outcome.value: outcome for outcome in Outcome}
        codes[-signal.SIGTERM] = Outcome.TERMINATED
        outcome = codes.get(process.exitcode or 0, Outcome.FAILED)
        if outcome.is_stopped and self._stopped_by:
            # Whatever came here went on as SIGTERM.
            outcome = Outcome.stopped_by(self._stopped_by)
        if outcome is Outcome.FAILED:
            complain('benchmark', f'{job.name} failed; see {job.folder / LOG_FILE}')
        elif outcome is Outcome.TAKEN:
            _tell(f'{job.name} is being run by another process')
        return job, outcome


def _work(job: Job, command: str) -> None:
    """The body of a process of `Processes`."""
    # Out of the terminal's group, so that Ctrl-C does not come twice; in the session of the caller,
    # because Linux shares processors out by session: in one of its own `nice` would not hold.
    os.setpgid(0, 0)
    parent = multiprocessing.parent_process()
    if parent is not None and parent.pid is not None:
        end_with_parent(parent.pid)
    job.folder.mkdir(parents=True, exist_ok=True)
    with (job.folder / LOG_FILE).open('a') as log:
        os.dup2(log.fileno(), sys.stdout.fileno())
        os.dup2(log.fileno(), sys.stderr.fileno())
    sys.exit(attempt(job, command).value)


def _from_anywhere(init_from: str) -> str:
    """What networks are called from every working directory: shipped actors keep their names."""
    path = Path(init_from)
    return str(path.resolve()) if init_from and path.exists() else init_from


class Ray:
    """As many jobs as the cluster has cores for; folders must lie where all its machines see."""

    def __init__(self, command: str) -> None:
        import ray

        ray.init(ignore_reinit_error=True, log_to_driver=True)
        self._ray = ray
        self.limit = sys.maxsize
        self._command = command
        self._attempt = ray.remote(max_retries=0)(attempt)
        self._running: dict[Any, Job] = {}

    def start(self, job: Job) -> None:
        """Gives the job to the cluster."""
        cores = max(job.config.simulation_threads, job.config.torch_threads, 1)
        config = dataclasses.replace(job.config, init_from=_from_anywhere(job.config.init_from))
        absolute = dataclasses.replace(job, config=config, folder=job.folder.resolve())
        self._running[self._attempt.options(num_cpus=cores).remote(absolute, self._command)] = job

    def wait(self) -> tuple[Job, Outcome]:
        """Waits for one of the jobs."""
        (done, *_), _ = self._ray.wait(list(self._running))
        job = self._running.pop(done)
        try:
            return job, self._ray.get(done)
        except self._ray.exceptions.RayError as error:
            complain('benchmark', f'{job.name}: {error}')
            return job, Outcome.FAILED
