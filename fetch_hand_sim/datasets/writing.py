"""Shared by all exports: exclusive access to a folder, and no overwriting."""

from __future__ import annotations

import fcntl
import importlib
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fetch_hand_sim.episode_log import EpisodeArrays
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from node_runtime.command_line import CommandError

ByTask = Mapping[str, Sequence[EpisodeArrays]]

_SETTINGS = ('control_hz', 'timing', 'reward_type', 'success_rule')


class ExportError(CommandError):
    """A dataset cannot be written; the message is one line."""


def why_apart(episode: EpisodeArrays, first: EpisodeArrays) -> str:
    """Return why an episode cannot be in a dataset with another of its task, '' if it can.

    A dataset of Minari has one environment, one of LeRobot has one rate, and rewards need one rule.
    """
    for name in _SETTINGS:
        if name == 'timing' and episode.record.control_hz == DEFAULT_CONTROL_HZ:
            # Both mean the same at this rate, and logs of 1.0 do not record it.
            continue
        here, there = getattr(episode.record, name), getattr(first.record, name)
        if here != there:
            return f'{name} {here}, and {there} in {first.path}; a dataset has one'
    return ''


def require_module(module: str) -> Any:
    """Import a module of the extra `[data]`.

    Raises:
        ExportError: If it is missing.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ExportError(
            f'{module.partition(".")[0]} is missing; install it with pip install '
            "'fetch_hand_sim[data]'"
        ) from error


@contextmanager
def alone_in(directory: Path) -> Iterator[None]:
    """Make a folder and lock it against other exports until the end of the block."""
    directory.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some file systems lack locks.
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def hidden_folder(directory: Path, name: str) -> Iterator[Path]:
    """Make a hidden folder in a locked one, and remove it at the end of the block.

    The hidden folder of a killed export is removed first.
    """
    hidden = directory / f'.{name}.partial'
    shutil.rmtree(hidden, ignore_errors=True)
    hidden.mkdir()
    try:
        yield hidden
    finally:
        shutil.rmtree(hidden, ignore_errors=True)


def require_new(paths: Iterable[Path]) -> None:
    """Raise `ExportError` if a path exists."""
    for path in paths:
        if path.exists():
            raise ExportError(f'{path} exists; nothing is overwritten')


def move_all(targets: Mapping[Path, Path]) -> None:
    """Rename files or folders, all of them or none.

    Args:
        targets: New path by present path, on the same disk.

    Raises:
        OSError: If one cannot be moved.
    """
    moved: list[Path] = []
    try:
        for source, target in targets.items():
            source.rename(target)
            moved.append(source)
    except BaseException:
        for source in moved:
            with suppress(OSError):
                targets[source].rename(source)
        raise
