"""Finds episodes that a killed process or a full disk cut off; nothing is changed here.

A directory of episodes may hold anything: what looks like a leftover and is none is reported as
one with a problem, and never followed, waited for or entered.
"""

from __future__ import annotations

import errno
import stat
import time
from dataclasses import dataclass
from pathlib import Path

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.errors import EpisodeLogError
from msgs_spec.text import printable


@dataclass(frozen=True, slots=True)
class Leftover:
    """An episode that was not completed.

    Attributes:
        name: Name of the episode.
        path: Its hidden directory.
        size_bytes: Size of its files.
        age_s: Seconds since the last write.
        problem: Why no robot left it like this; empty if one may have.
    """

    name: str
    path: Path
    size_bytes: int
    age_s: float
    problem: str = ''

    def __str__(self) -> str:
        if self.problem:
            return printable(f'no episode of a robot: {self.problem}')
        return printable(
            f'unfinished episode {self.name}: {self.size_bytes / 1024:.0f} KiB in {self.path}, '
            f'last written {self.age_s:.0f} s ago'
        )


def find_leftovers(directory: Path | str, now_s: float | None = None) -> list[Leftover]:
    """Returns the unfinished episodes in a directory by name, without those in progress.

    Args:
        directory: Where episodes are collected; may be missing.
        now_s: Time since the epoch to measure age by; the system clock by default.

    Raises:
        EpisodeLogError: If the directory cannot be read.
    """
    now = time.time() if now_s is None else now_s
    try:
        found = [inspect_leftover(path, now) for path in sorted(Path(directory).iterdir())]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise EpisodeLogError(
            f'cannot read episodes: {error.filename}: {error.strerror}'
        ) from error
    return [leftover for leftover in found if leftover is not None]


def inspect_leftover(path: Path, now_s: float) -> Leftover | None:
    """Returns what is in a hidden directory, None if it is in progress or was just completed."""
    name = durable.active_name(path)
    if name is None:
        return None
    try:
        files = _files(path, name)
        if any(durable.is_locked(file) for file in files):
            return None
        statuses = [file.lstat() for file in files]
        written = max(status.st_mtime for status in statuses or [path.lstat()])
    except FileNotFoundError:
        return None  # It was completed while we looked.
    except OSError as error:
        problem = f'{error.filename or path}: {error.strerror}'
        return Leftover(name, path, size_bytes=0, age_s=0.0, problem=problem)
    return Leftover(
        name=name,
        path=path,
        size_bytes=sum(status.st_size for status in statuses),
        age_s=max(0.0, now_s - written),
    )


def _files(path: Path, name: str) -> list[Path]:
    """The entries of a hidden directory.

    Raises:
        OSError: If it is none, or holds what no writer puts there.
    """
    if not stat.S_ISDIR(path.lstat().st_mode):
        raise NotADirectoryError(errno.ENOTDIR, 'is no directory', str(path))
    files = sorted(path.iterdir())
    file = durable.bag_file(path, name)
    known = {file, durable.rewritten_file(file), durable.metadata_file(path)}
    for entry in files:
        if entry not in known:
            raise OSError(errno.EINVAL, 'is not of an episode', str(entry))
        if not stat.S_ISREG(entry.lstat().st_mode):
            raise OSError(errno.EINVAL, 'is no regular file', str(entry))
    return files
