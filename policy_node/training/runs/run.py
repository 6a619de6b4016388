"""One run from its first step to its last: what it needs, its folder, signals, log and curve."""

from __future__ import annotations

import contextlib
import fcntl
import signal
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import numpy as np

from msgs_spec.text import one_line
from node_runtime.command_line import (
    CommandError,
    UsageError,
    complain,
    complain_from_handler,
    require_extra,
)
from node_runtime.signals import on_stop_signals
from node_runtime.source_revision import source_revision
from policy_node.training.configuration.config import TrainConfig, idle_parts
from policy_node.training.configuration.groups import Imitation
from policy_node.training.experience.replay import Episodes
from policy_node.training.machine.devices import choose_device
from policy_node.training.machine.distributed import is_first_worker, join_workers, leave_workers
from policy_node.training.machine.host import available_memory, why_too_large
from policy_node.training.runs.finite_checks import TrainingError
from policy_node.training.runs.imitation import ImitationTrainer
from policy_node.training.runs.initial_networks import InitialNetworks
from policy_node.training.runs.read_networks import read_initial_networks
from policy_node.training.runs.run_folder import (
    COMMAND_FILE,
    CURVE_FILE,
    LOCK_FILE,
    PROGRESS_FILE,
    STATE_FILE,
    set_former_run_aside,
)
from policy_node.training.runs.run_log import Row, RunLog, draw_curve, read_progress
from policy_node.training.runs.saving import NAME
from policy_node.training.runs.trainer import Trainer
from policy_node.training.runs.training_state import Counters

# Told of a cycle with what `progress.csv` has of it; what it returns matters if it is False.
OnCycle = Callable[[Row], object]
AnyTrainer = Trainer | ImitationTrainer


@dataclass(frozen=True, slots=True)
class Caller:
    """A program that trains; a second Ctrl-C raises KeyboardInterrupt there and does not end it.

    Attributes:
        on_cycle: Is told of each cycle; the run ends when it returns False.
        quiet: Whether progress is not shown.
    """

    on_cycle: OnCycle | None = None
    quiet: bool = False


class _OfCallerError(Exception):
    """What `on_cycle` raised, so that no error of a run is taken for it, nor it for one."""

    def __init__(self, error: Exception) -> None:
        super().__init__(error)
        self.error = error


class RunTakenError(CommandError):
    """Another process works on the run."""


@dataclass(frozen=True, slots=True)
class Ending:
    """How a run, or this part of it, ended.

    Attributes:
        reason: Why, for people.
        counters: How far it is.
        signal: Number of the signal that stopped it; 0 if it ended by itself.
    """

    reason: str
    counters: Counters
    signal: int = 0


def train_run(
    config: TrainConfig,
    output: Path,
    *,
    resume: bool = False,
    command: str = '',
    experience: Episodes | None = None,
    caller: Caller | None = None,
) -> Ending:
    """Trains as configured, in this process, until a limit or a signal ends it.

    Args:
        config: What to train and how.
        output: Folder of the run.
        resume: Continue the run in the folder; else it must hold none.
        command: Command line, for the record.
        experience: Episodes to learn from as well.
        caller: The program that this is called from; None is a command of ours.

    Raises:
        UsageError: If something that the run needs is missing or does not fit; nothing is written
            but the folder and its lock.
        RunTakenError: If another process works on the folder.
        CommandError: If training failed; the last checkpoint is kept.
    """
    require_extra('train')
    networks = _initial_networks(config) if config.network.init_from and not resume else None
    with lock_run(output) if is_first_worker() else contextlib.nullcontext():
        if not resume and (output / STATE_FILE).exists():
            raise UsageError(f'{output} holds a run; continue it with --resume or choose another')
        trainer = _make_trainer(config, output, command, networks, resume, experience)
        if isinstance(trainer, Trainer) and (why := _too_large(trainer)):
            complain(NAME, why)
        ending = _train_or_explain(trainer, output, command, caller, resume=resume)
        if trainer.workers.is_first:
            title = f'{config.task}, {config.recipe} recipe, seed {config.seed}'
            try:
                draw_curve(read_progress(output / PROGRESS_FILE), title, output / CURVE_FILE)
            except OSError as error:
                complain(NAME, f'no curve, the run itself is saved: {error}')
        return ending


def _make_trainer(
    config: TrainConfig,
    output: Path,
    command: str,
    networks: InitialNetworks | None,
    resume: bool,
    experience: Episodes | None,
) -> AnyTrainer:
    """Return the trainer with what it starts from.

    Raises:
        UsageError: If something does not fit the configuration or the memory of the machine.
    """
    try:
        workers = join_workers(choose_device(config.machine.device))
        if isinstance(config.learner, Imitation):
            assert networks is not None, 'imitation starts from a policy and is not resumed'
            return ImitationTrainer(config, output, workers, command, source_revision(), networks)
        trainer = Trainer(config, output, workers, command, source_revision(), networks)
        if resume:
            trainer.resume(output / STATE_FILE)
        if experience is not None:
            trainer.add_experience(experience)
    except ValueError as error:
        raise UsageError(str(error)) from None
    except (MemoryError, RuntimeError) as error:
        raise _without_memory(error) from None
    return trainer


def _train_or_explain(
    trainer: AnyTrainer,
    output: Path,
    command: str,
    caller: Caller | None,
    *,
    resume: bool,
) -> Ending:
    """Trains; what fails is one line, and what the caller raised stays as it is."""
    try:
        return _train(trainer, output, command, caller, resume=resume)
    except (TrainingError, OSError) as error:
        raise CommandError(f'{error}; {_kept(output)}') from None
    except _OfCallerError as error:
        theirs = error.error
    finally:
        leave_workers(trainer.workers)
    # Here, so that nothing of ours is around it.
    raise theirs


def _kept(output: Path) -> str:
    """What is left of a run that failed."""
    if (output / STATE_FILE).is_file():
        return f'the last checkpoint is kept in {output}'
    return f'{output} has no checkpoint to go on from'


def _without_memory(error: MemoryError | RuntimeError) -> Exception:
    """What to raise where a run is larger than the machine; torch has no class for that."""
    if isinstance(error, RuntimeError) and 'allocate' not in str(error):
        return error
    fields = 'replay_transitions, num_envs and hidden_sizes decide how much is needed'
    return UsageError(f'not enough memory; {fields}: {one_line(error)}')


def _too_large(trainer: Trainer) -> str:
    """Warns of a replay that this worker's memory will not hold, which ends a run hours later."""
    replay = trainer.experience.replay
    left = max(trainer.config.run.total_steps - trainer.counters.env_steps, 0)
    episodes = len(replay) + trainer.workers.share(left) // replay.ticks
    needed = replay.bytes_of(episodes) - replay.bytes_of(len(replay))
    return why_too_large(needed, available_memory())


def _train(
    trainer: AnyTrainer,
    output: Path,
    command: str,
    caller: Caller | None,
    *,
    resume: bool,
) -> Ending:
    log = None
    if trainer.workers.is_first:
        _prepare_folder(trainer, output, command, resume)
        config, on_row = trainer.config, _row_listener(trainer, caller)
        log = RunLog(
            output,
            config.run.total_steps,
            config.run.time_limit,
            trainer.counters.env_steps,
            quiet=caller is not None and caller.quiet,
            on_row=on_row,
        )
    try:
        with _stop_on_signals(trainer, is_guest=caller is not None) as received:
            reason = trainer.train(log)
    finally:
        if log is not None:
            log.close()
    return Ending(reason, trainer.counters, received[0] if received else 0)


def _prepare_folder(trainer: AnyTrainer, output: Path, command: str, resume: bool) -> None:
    """Set files of an earlier run aside, record the command and warn of idle parts."""
    if not resume and (said := set_former_run_aside(output)):
        complain(NAME, said)
    # One line for each part; a run that was killed before its first checkpoint leaves none.
    if not resume or trainer.counters.env_steps < trainer.config.run.total_steps:
        with (output / COMMAND_FILE).open('a' if resume else 'w') as file:
            file.write(command + '\n')
    for line in idle_parts(trainer.config):
        complain(NAME, line)


def _row_listener(trainer: AnyTrainer, caller: Caller | None) -> Callable[[Row], None] | None:
    """Return the function that passes each cycle to the caller, or None."""
    on_cycle = caller.on_cycle if caller else None
    if on_cycle is None:
        return None

    def tell(row: Row) -> None:
        try:
            result = on_cycle(row)
        except Exception as error:
            raise _OfCallerError(error) from error
        if isinstance(result, bool | np.bool_) and not result:
            trainer.stop('stopped by on_cycle')

    return tell


@contextlib.contextmanager
def lock_run(folder: Path) -> Iterator[None]:
    """Makes the folder of a run and keeps other processes out of it.

    The lock ends with the process, however that ends. Some file systems of clusters have none; a
    line says so.

    Raises:
        UsageError: If the folder cannot be made or written to.
        RunTakenError: If another process works on it.
    """
    try:
        str(folder).encode()
        folder.mkdir(parents=True, exist_ok=True)
        lock = (folder / LOCK_FILE).open('w')
    except OSError as error:
        raise UsageError(f'{folder} cannot hold a run: {error.strerror}') from None
    except UnicodeEncodeError:
        why = 'TensorBoard takes names in UTF-8 alone'
        raise UsageError(f'{folder} cannot hold a run: {why}') from None
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise RunTakenError(f'{folder} is being trained by another process') from None
        except OSError as error:
            why = f'no locks where it lies ({error.strerror})'
            complain(NAME, f'{folder} cannot be kept from other processes: {why}')
        yield


def _initial_networks(config: TrainConfig) -> InitialNetworks:
    """Reads the networks to start from."""
    try:
        networks = read_initial_networks(config.network.init_from).fitted(config)
    except ValueError as error:
        raise UsageError(str(error)) from None
    if not networks.has_critic and not isinstance(config.learner, Imitation):
        complain(
            NAME, f'{config.network.init_from} has no critic for this run: a new one learns first'
        )
    return networks


@contextlib.contextmanager
def _stop_on_signals(trainer: AnyTrainer, is_guest: bool = False) -> Iterator[list[int]]:
    """Ctrl-C, SIGTERM and SIGHUP end the run after the cycle; a second one ends it at once.

    Args:
        trainer: Of the run.
        is_guest: Whether a second Ctrl-C must leave the process alive.

    Yields:
        A list that will hold the number of the signal.
    """

    def stop(number: int, frame: FrameType | None) -> None:
        del frame
        trainer.stop(f'stopped by {signal.Signals(number).name}')
        complain_from_handler(NAME, 'stopping after this cycle; once more stops at once')

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    with on_stop_signals(numbers, stop, raises_again=is_guest) as received:
        yield received
