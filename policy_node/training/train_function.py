"""The function `train`, which does in Python what `fetch_hand_sim train` does."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import typed_fields
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.runs.run import Caller, OnCycle, resumed_config, train_run
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
    """The result of `train`.

    Attributes:
        folder: Folder of the run.
        config: Configuration of the run.
        reason: Why the run ended, in words.
        env_steps: Environment steps, including those before the run was resumed.
        seconds: Wall-clock time of training, including the time before the run was resumed.
        best_success: Success at the last step in the best evaluation; -1.0 without an evaluation.
    """

    folder: Path
    config: TrainConfig = field(repr=False)
    reason: str
    env_steps: int
    seconds: float
    best_success: float

    @property
    def actor(self) -> Path:
        """File of the best actor; of the latest actor if there was no evaluation."""
        best = self.folder / BEST_FILE
        return best if best.is_file() else self.folder / LATEST_FILE

    def progress(self) -> list[dict[str, float]]:
        """Return a row of `progress.csv` per cycle; values that were not measured are missing."""
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
    """Train an actor with DDPG and hindsight experience replay, in this process.

    Ctrl-C (or "interrupt" in a notebook) saves the run after the cycle and raises
    KeyboardInterrupt; `resume=True` continues it. A second Ctrl-C raises at once. SIGTERM and
    SIGHUP also save the run, then raise SystemExit; a second SIGTERM ends the process. Outside the
    main thread, signals have no effect.

    Args:
        task: Task name (`msgs_spec.tasks.TASKS`).
        output: Folder of the run; default: `runs/<task>_<recipe>_seed<seed>`.
        recipe: `best` (the default), `paper`, `robust` or `finetune`.
        resume: Continue the run in `output` with its configuration, changed by `fields`.
        on_cycle: Called after every cycle with its row of `progress.csv`; values are None if not
            measured. The run ends after this cycle if it returns False or raises an exception.
        quiet: Show no progress.
        **fields: Fields of `TrainConfig`, such as `total_steps`, `seed`, `success_target`.

    Raises:
        ValueError: If an argument is invalid or the folder cannot be used. Nothing was trained.
        RuntimeError: If training fails, or another process trains in the folder.
        ModuleNotFoundError: If the extra `train` is missing.
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
            raise ValueError('resume=True needs output, the folder of the run')
        folder = Path(os.path.expanduser(output))
        config = resumed_config(folder, task, recipe, fields)
    else:
        config = recipe_config(task, 'best' if recipe is None else recipe, **fields)
        folder = Path(default_folder(config) if output is None else os.path.expanduser(output))
        if (folder / STATE_FILE).is_file():
            raise ValueError(f'{folder} contains a run. Use resume=True or choose another folder')
    given: dict[str, Any] = {} if recipe is None else {'recipe': recipe}
    given |= ({'resume': True} if resume else {}) | fields
    named = ''.join(f', {name}={value!r}' for name, value in given.items())
    command = f'policy_node.training.train({task!r}, {str(folder)!r}{named})'
    with _torch_restored():
        caller = Caller(on_cycle, quiet)
        ending = train_run(config, folder, resume=resume, command=command, caller=caller)
    if ending.signal == signal.SIGINT:
        raise KeyboardInterrupt(ending.reason)
    if ending.signal:
        raise SystemExit(128 + ending.signal)
    counters = ending.counters
    return Run(
        folder, config, ending.reason, counters.env_steps, counters.seconds, counters.best_success
    )


@contextlib.contextmanager
def _torch_restored() -> Iterator[None]:
    """Return a context that restores torch's number of threads and random state at its end."""
    threads = torch.get_num_threads()
    try:
        with torch.random.fork_rng():
            yield
    finally:
        torch.set_num_threads(threads)
