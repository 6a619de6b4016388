"""The function `train`: `fetch_hand_sim train` for Python."""

from __future__ import annotations

import contextlib
import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import Any

import torch

from node_runtime.command_line import CommandError, UsageError
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import typed_fields
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.runs.resumed_config import resumed_config
from policy_node.training.runs.run import Caller, Ending, OnCycle, train_run
from policy_node.training.runs.run_folder import (
    BEST_FILE,
    LATEST_FILE,
    PROGRESS_FILE,
    STATE_FILE,
    default_folder,
)
from policy_node.training.runs.run_log import read_progress


@dataclass(frozen=True, slots=True)
class Run:
    """A run of `train` that has ended.

    Attributes:
        folder: Where its files are.
        config: How it was configured.
        reason: Why it ended, for people.
        env_steps: Environment steps, of all its parts.
        seconds: Time spent, likewise.
        best_success: Success at the last step of the best evaluation; -1.0 without one.
    """

    folder: Path
    config: TrainConfig = field(repr=False)
    reason: str
    env_steps: int
    seconds: float
    best_success: float

    @property
    def actor(self) -> Path:
        """File of the best actor, or of the newest where none was evaluated.

        `policy_node.load_actor` and whatever takes a policy read it.
        """
        best = self.folder / BEST_FILE
        return best if best.is_file() else self.folder / LATEST_FILE

    def progress(self) -> list[dict[str, float]]:
        """A row per cycle: `env_steps`, `train_success`, `eval_success` where evaluated, ..."""
        return read_progress(self.folder / PROGRESS_FILE)


def train(
    task: str,
    output: str | Path | None = None,
    *,
    recipe: str | None = None,
    resume: bool = False,
    on_cycle: OnCycle | None = None,
    quiet: bool = False,
    **fields: Any,
) -> Run:
    """Trains an actor with DDPG and hindsight experience replay, in this process.

    Ctrl-C (or "interrupt" of a notebook) ends it after the cycle with all saved, and raises
    KeyboardInterrupt; `resume=True` goes on from there. A second one raises at once. SIGTERM and
    SIGHUP end it in the same way and raise SystemExit; a second SIGTERM ends the process. In a
    thread other than the main one signals do nothing.

    Args:
        task: One of the tasks (`msgs_spec.tasks.TASKS`).
        output: Folder of the run; None is `runs/<task>_<recipe>_seed<seed>`.
        recipe: `best` (the default), `paper` or `finetune`.
        resume: Go on with the run in `output`, whose configuration stays but for `fields`.
        on_cycle: Called after every cycle with what `progress.csv` says of it, None for what was
            not measured. The run ends when it returns False, or with what it raises.
        quiet: Whether progress is not shown.
        **fields: Of `TrainConfig`, such as `total_steps`, `seed`, `success_target`.

    Raises:
        ValueError: If something is not allowed, or the folder cannot be used; nothing was trained.
        RuntimeError: If training failed, or another process trains in the folder.
        ModuleNotFoundError: If what the extra `train` brings is missing.
        KeyboardInterrupt: After Ctrl-C.
        SystemExit: After SIGTERM or SIGHUP, with code 143 or 129.
    """
    if on_cycle is not None and not callable(on_cycle):
        raise ValueError(f'on_cycle {on_cycle!r}; allowed: None or a function')
    if output is not None and not (isinstance(output, str | os.PathLike) and str(output)):
        raise ValueError(f'output {output!r:.60}; allowed: the path of a folder, or None')
    if not isinstance(resume, bool):
        raise ValueError(f'resume {resume!r:.60}; allowed: True or False')
    fields = typed_fields(fields)
    if resume:
        if output is None:
            raise ValueError('resume=True needs output, the folder of the run to go on with')
        folder = Path(os.path.expanduser(output))
        config = resumed_config(folder, task, recipe, fields)
    else:
        config = recipe_config(task, 'best' if recipe is None else recipe, **fields)
        folder = Path(default_folder(config) if output is None else os.path.expanduser(output))
        if (folder / STATE_FILE).is_file():
            raise ValueError(
                f'{folder} holds a run: resume=True goes on with it, or choose another'
            )
    given: dict[str, Any] = {} if recipe is None else {'recipe': recipe}
    given |= {'resume': True} if resume else {}
    command = _command(task, folder, given | fields)
    with _PROGRAM:
        ending = _ending(config, folder, resume, command, Caller(on_cycle, quiet))
    if ending.signal == signal.SIGINT:
        raise KeyboardInterrupt(ending.reason)
    if ending.signal:
        raise SystemExit(128 + ending.signal)
    counters = ending.counters
    return Run(
        folder, config, ending.reason, counters.env_steps, counters.seconds, counters.best_success
    )


def _command(task: str, folder: Path, given: dict[str, Any]) -> str:
    """The call in one line, for the record."""
    named = [f'{name}={value!r}' for name, value in given.items()]
    return f'policy_node.training.train({", ".join([repr(task), repr(str(folder)), *named])})'


def _ending(
    config: TrainConfig, folder: Path, resume: bool, command: str, caller: Caller
) -> Ending:
    """Runs it; what commands say in one line are errors as Python has them."""
    try:
        return train_run(config, folder, resume=resume, command=command, caller=caller)
    except UsageError as error:
        raise ValueError(str(error)) from error
    except CommandError as error:
        raise RuntimeError(str(error)) from error


class _Program:
    """What a run changes in the program around it, given back when no run is left.

    Several may run at the same time, in threads.
    """

    def __init__(self) -> None:
        self._lock = Lock()
        self._runs = 0
        self._kept = contextlib.ExitStack()

    def __enter__(self) -> None:
        with self._lock:
            if self._runs == 0:
                self._kept.callback(torch.set_num_threads, torch.get_num_threads())
                self._kept.enter_context(torch.random.fork_rng())
            self._runs += 1

    def __exit__(self, *exception: object) -> None:
        with self._lock:
            self._runs -= 1
            if self._runs == 0:
                self._kept.close()


_PROGRAM = _Program()
