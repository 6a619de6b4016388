"""Helpers of all exports: a dataset appears only when complete, and nothing is overwritten."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from tempfile import TemporaryDirectory

from fetch_hand_sim.episode_log import EpisodeArrays
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from node_runtime.command_line import CommandError

ByTask = Mapping[str, Sequence[EpisodeArrays]]

# Exports write into a folder of such a name first.
_HIDDEN = '.partial.'
_SETTINGS = ('control_hz', 'timing', 'reward_type', 'success_rule')


class ExportError(CommandError):
    """A dataset cannot be written; the message is one line."""


def why_apart(episode: EpisodeArrays, first: EpisodeArrays) -> str:
    """Return why an episode cannot share a dataset with the episode `first`, or '' if it can.

    All episodes of a dataset have the same control rate, timing, reward type and success rule.
    """
    for name in _SETTINGS:
        if name == 'timing' and episode.record.control_hz == DEFAULT_CONTROL_HZ:
            # Both mean the same at this rate, and logs of 1.0 do not record it.
            continue
        here, there = getattr(episode.record, name), getattr(first.record, name)
        if here != there:
            return f'{name} {here}, and {there} in {first.path}; a dataset has one'
    return ''


@contextmanager
def alone_in(directory: Path) -> Iterator[bool]:
    """Lock a folder, created if missing, until the block ends; wait for another process's lock.

    Yield whether the folder is locked. Some file systems lack locks.
    """
    directory.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    is_locked = False
    try:
        with suppress(OSError):
            fcntl.flock(descriptor, fcntl.LOCK_EX)
            is_locked = True
        yield is_locked
    finally:
        os.close(descriptor)


@contextmanager
def appearing(directory: Path, names: Iterable[str]) -> Iterator[Path]:
    """Yield a hidden folder; if the block succeeds, move its entries `names` to `directory`.

    Hidden folders of exports that were killed are removed first.

    Raises:
        ExportError: If `directory` already contains one of `names`, or the disk fails.
    """
    targets = {name: directory / name for name in names}
    try:
        with alone_in(directory) as is_locked:
            if is_locked:
                for leftover in directory.glob(f'{_HIDDEN}*'):
                    shutil.rmtree(leftover, ignore_errors=True)
            for path in targets.values():
                if path.exists():
                    raise ExportError(f'{path} exists; nothing is overwritten')
            with TemporaryDirectory(prefix=_HIDDEN, dir=directory) as hidden:
                yield Path(hidden)
                for name, target in targets.items():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    (Path(hidden) / name).rename(target)
    except OSError as error:
        raise ExportError(f'{directory}: {error.strerror or error}') from error
