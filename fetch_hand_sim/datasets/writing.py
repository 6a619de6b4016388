"""What all exports do: they are alone in their folder, and overwrite nothing."""

from __future__ import annotations

import fcntl
import importlib
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from fetch_hand_sim.episode_log import EpisodeArrays
from msgs_spec.command_line import CommandError

ByTask = Mapping[str, Sequence[EpisodeArrays]]


class ExportError(CommandError):
    """A dataset cannot be written; the message is one line."""


def require_module(module: str) -> Any:
    """Imports a module of the extra.

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
    """Makes a folder and waits until nobody else who asks for that writes to it."""
    directory.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        # Some file systems have no locks.
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def require_new(paths: Iterable[Path]) -> None:
    """Raises `ExportError` if one of them is there."""
    for path in paths:
        if path.exists():
            raise ExportError(f'{path} exists; nothing is overwritten')
