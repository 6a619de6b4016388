"""One run from start to end: its initial networks, folder lock, signals, log and curve."""

from __future__ import annotations

import contextlib
import fcntl
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from msgs_spec.text import one_line
from node_runtime.command_line import complain, complain_from_handler
from node_runtime.signals import on_stop_signals
from node_runtime.source_revision import source_revision
from policy_node.training.configuration.config import TrainConfig, idle_note
from policy_node.training.configuration.flat import config_from_dict, removed_fields
from policy_node.training.experience.replay import Episodes
from policy_node.training.machine import (
    available_memory,
    choose_device,
    is_first_worker,
    join_workers,
    leave_workers,
    uses_bfloat16,
)
from policy_node.training.runs.imitation import ImitationTrainer
from policy_node.training.runs.initial_networks import InitialNetworks, read_initial_networks
from policy_node.training.runs.run_folder import (
    COMMAND_FILE,
    CURVE_FILE,
    LOCK_FILE,
    NAME,
    PROGRESS_FILE,
    STATE_FILE,
    RunFolder,
    disk_warning,
    set_former_run_aside,
)
from policy_node.training.runs.run_log import Row, RunLog, draw_curve, read_progress
from policy_node.training.runs.trainer import Trainer
from policy_node.training.runs.training_state import Counters, TrainingError, read_state

# Called after each cycle with its row of `progress.csv`; the run ends if it returns False.
OnCycle = Callable[[Row], object]
AnyTrainer = Trainer | ImitationTrainer
# Fields that a resumed run cannot change.
_FIXED = (
    'hidden_sizes layer_norm goal_features algorithm critics quantiles norm advantage condition '
    'longest_hold subgoal_every init_from start_share seed control_hz reward_type discount gamble '
    'past_actions'
).split()
# They end the run after the cycle.
_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


@dataclass(slots=True)
class Caller:
    """The Python program that called `train`; a second Ctrl-C raises KeyboardInterrupt in it.

    Attributes:
        on_cycle: Function to call after each cycle with its row of `progress.csv`, or None.
        quiet: Show no progress.
        error: Exception that `on_cycle` raised, which ended the run; None without one.
    """

    on_cycle: OnCycle | None = None
    quiet: bool = False
    error: Exception | None = field(default=None, init=False)


class RunTakenError(TrainingError):
    """Raised if another process trains in the folder of the run."""


@dataclass(frozen=True, slots=True)
class Ending:
    """The end of a run, or of a part of it that may be resumed later.

    Attributes:
        counters: Progress of the run at its end.
        signal: Number of the signal that stopped the run; 0 without a signal.
    """

    reason: str
    counters: Counters
    signal: int = 0


def resumed_config(
    folder: Path, task: str | None, recipe: str | None, changes: Mapping[str, Any]
) -> TrainConfig:
    """Return the configuration of the run in `folder`, with `changes`, to resume it.

    `task` and `recipe` must be those of the run, or None if the user gives none.

    Raises:
        ValueError: If the folder contains no run, `task` or `recipe` differ from it, or a field
            cannot change.
    """
    if not (folder / STATE_FILE).is_file():
        raise ValueError(
            f'{folder / STATE_FILE} does not exist: the folder is missing, its run has no '
            'checkpoint, or the recipe is robust, which cannot be resumed'
        )
    stored = read_state(folder / STATE_FILE).extra['config']
    for name, chosen in (('task', task), ('recipe', recipe)):
        if chosen not in (None, stored.get(name)):
            raise ValueError(f'{folder} is a run of {stored.get(name)}, not of {chosen}')
    for name, value in removed_fields(stored).items():
        raise ValueError(f'{folder} was trained with {name} {value!r}, removed in version 2.0')
    before, config = config_from_dict(stored), config_from_dict(stored, **changes)
    for name in _FIXED:
        old, new = getattr(before, name), getattr(config, name)
        if old != new:
            raise ValueError(f'{folder} has {name} {old!r}, which cannot change to {new!r}')
    return config


def train_run(
    config: TrainConfig,
    output: Path,
    *,
    resume: bool = False,
    command: str = '',
    experience: Episodes | None = None,
    caller: Caller | None = None,
) -> Ending:
    """Train in this process until a limit of `config`, a signal or `on_cycle` ends the run.

    Args:
        resume: Continue the run in the folder `output`; otherwise it must contain no run.
        command: Command line or call that started the run, for the record.
        experience: Logged episodes to learn from in addition to collected ones, or None.
        caller: The calling Python program; None if a command started the run.

    Raises:
        ValueError: If an argument is invalid or does not fit the run. Nothing was trained; only the
            folder and its lock exist.
        RunTakenError: If another process trains in the folder.
        TrainingError: If training fails; the last checkpoint stays.
    """
    networks = None
    if config.init_from and not resume:
        networks = read_initial_networks(config.init_from).fitted(config)
        if not networks.critics and config.algorithm != 'imitation':
            complain(NAME, f'{config.init_from} has no critic for this run; a new one learns first')
    with lock_run(output) if is_first_worker() else contextlib.nullcontext():
        if not resume and (output / STATE_FILE).exists():
            raise ValueError(f'{output} contains a run. Use --resume or choose another folder')
        trainer = _make_trainer(config, output, command, networks, resume, experience)
        if isinstance(trainer, Trainer):
            _warn_of_memory(trainer)
        try:
            ending = _train(trainer, caller, resume=resume)
        except (TrainingError, OSError) as error:
            note = f'{output} contains no checkpoint'
            if (output / STATE_FILE).is_file():
                note = f'the last checkpoint is in {output}'
            raise TrainingError(f'{error}; {note}') from None
        except ValueError as error:
            # A defect, not a wrong argument: commands show its traceback.
            raise RuntimeError(f'training failed: {error}') from error
        finally:
            leave_workers(trainer.workers)
        if caller is not None and caller.error is not None:
            raise caller.error
        return ending


def _make_trainer(
    config: TrainConfig,
    output: Path,
    command: str,
    networks: InitialNetworks | None,
    resume: bool,
    experience: Episodes | None,
) -> AnyTrainer:
    """Return a trainer with the logged episodes added, new or with `resume` that of `output`.

    A new trainer starts with `networks`, or with random ones if they are None.

    Raises:
        ValueError: If the training state or the logged episodes do not fit the configuration, or
            memory is too small.
    """
    try:
        workers = join_workers(choose_device(config.device))
        folder = RunFolder(output, config, workers, command, source_revision())
        if config.algorithm == 'imitation':
            assert networks is not None, 'imitation starts from a policy and is not resumed'
            return ImitationTrainer(folder, networks)
        trainer = Trainer(folder, networks)
        if resume:
            trainer.resume(output / STATE_FILE)
        if experience is not None:
            trainer.add_experience(experience)
    except (MemoryError, RuntimeError) as error:
        # torch has no class for this error.
        if isinstance(error, RuntimeError) and 'allocate' not in str(error):
            raise
        fields = 'replay_transitions, num_envs or hidden_sizes'
        raise ValueError(f'not enough memory; use smaller {fields}: {one_line(error)}') from None
    return trainer


def _warn_of_memory(trainer: Trainer) -> None:
    """Warn if the replay, once full, will exceed the free memory of this machine.

    Linux reserves memory without checking it, so the run would fail only after hours.
    """
    replay, available = trainer.experience.replay, available_memory()
    left = max(trainer.config.total_steps - trainer.counters.env_steps, 0)
    episodes = len(replay) + trainer.workers.share(left) // replay.ticks
    needed = replay.bytes_of(episodes) - replay.bytes_of(len(replay))
    if available is not None and needed > available:
        complain(
            NAME,
            f'the replay grows to {needed / 1e9:.1f} GB and {available / 1e9:.1f} GB are free; '
            'a smaller replay_transitions would fit',
        )


def _train(trainer: AnyTrainer, caller: Caller | None, *, resume: bool) -> Ending:
    log, config, output = None, trainer.config, trainer.folder.path
    if trainer.workers.is_first:
        _prepare_folder(trainer, resume)
        log = RunLog(
            output,
            config.total_steps,
            config.time_limit,
            trainer.counters.env_steps,
            quiet=caller is not None and caller.quiet,
            on_row=_row_listener(trainer, caller),
        )

    def stop(number: int, frame: FrameType | None) -> None:
        del frame
        trainer.stop(f'stopped by {signal.Signals(number).name}')
        complain_from_handler(NAME, 'stopping after this cycle; once more stops at once')

    try:
        # A second Ctrl-C raises KeyboardInterrupt in a program of a user and else ends the process.
        with on_stop_signals(_SIGNALS, stop, raises_again=caller is not None) as received:
            reason = trainer.train(log)
    finally:
        if log is not None:
            log.close()
    if log is not None:
        title = f'{config.task}, {config.recipe} recipe, seed {config.seed}'
        with disk_warning('no curve, the run itself is saved'):
            draw_curve(read_progress(output / PROGRESS_FILE), title, output / CURVE_FILE)
    return Ending(reason, trainer.counters, received[0] if received else 0)


def _prepare_folder(trainer: AnyTrainer, resume: bool) -> None:
    """Record the command; before a new run, move files of an earlier run into a subfolder.

    Also warn of a run that ends before its first update, and of bfloat16 that the processor only
    emulates.
    """
    output = trainer.folder.path
    if not resume and (note := set_former_run_aside(output)):
        complain(NAME, note)
    if not resume or trainer.counters.env_steps < trainer.config.total_steps:
        # One line for each part of the run.
        with (output / COMMAND_FILE).open('a' if resume else 'w') as file:
            file.write(trainer.folder.command + '\n')
        first = trainer.learner.critic_first if isinstance(trainer, Trainer) else 0
        if note := idle_note(trainer.config, first):
            complain(NAME, note)
    precision, device = trainer.config.precision, choose_device(trainer.config.device)
    # Other algorithms use float32.
    is_used = trainer.config.algorithm == 'ddpg' and uses_bfloat16(precision, device)
    if is_used and not uses_bfloat16('auto', device):
        # Measured on a CPU with AVX2: 50 times longer for 1024 x 256 times 256 x 256.
        note = 'this processor emulates it and learns many times slower; use precision=float32'
        complain(NAME, f'precision {precision}: {note}')


def _row_listener(trainer: AnyTrainer, caller: Caller | None) -> Callable[[Row], None] | None:
    """Return a function that calls `on_cycle` with each row; None if the caller has no `on_cycle`.

    The run stops after the cycle if `on_cycle` returns False or raises an exception.
    """
    if caller is None or (on_cycle := caller.on_cycle) is None:
        return None

    def listen(row: Row) -> None:
        try:
            result = on_cycle(row)
        except Exception as error:
            caller.error = error
            trainer.stop('stopped by an error in on_cycle')
        else:
            if isinstance(result, bool | np.bool_) and not result:
                trainer.stop('stopped by on_cycle')

    return listen


@contextlib.contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Create the folder of a run and keep other processes from training in it.

    The lock is released at the end of the block or of the process. If the file system does not
    support locks, the run continues with a warning.

    Raises:
        ValueError: If the folder cannot be created or written.
        RunTakenError: If another process trains in it.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK_FILE).open('w')
    except OSError as error:
        raise ValueError(f'{folder} cannot hold a run: {error.strerror}') from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunTakenError(f'{folder} is being trained by another process') from None
        except OSError as error:
            complain(NAME, f'{folder} has no lock against other processes: {error.strerror}')
        yield
