"""Finds episodes that a killed process or a full disk cut off. Nothing is ever deleted here."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.errors import EpisodeLogError


@dataclass(frozen=True, slots=True)
class Leftover:
    """An episode that was not completed.

    Attributes:
        name: Name of the episode.
        path: Its hidden directory.
        size_bytes: Size of its files.
        age_s: Seconds since the last write.
    """

    name: str
    path: Path
    size_bytes: int
    age_s: float

    def __str__(self) -> str:
        return (
            f'unfinished episode {self.name}: {self.size_bytes / 1024:.0f} KiB in {self.path}, '
            f'last written {self.age_s:.0f} s ago'
        )


def find_leftovers(directory: Path, now_s: float | None = None) -> list[Leftover]:
    """Returns the unfinished episodes in a directory by name, without those in progress.

    Args:
        directory: Where episodes are collected; may be missing.
        now_s: Time since the epoch to measure age by; the system clock by default.

    Raises:
        EpisodeLogError: If the directory cannot be read.
    """
    now = time.time() if now_s is None else now_s
    try:
        found = [_leftover(path, now) for path in sorted(directory.iterdir())]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise EpisodeLogError(
            f'cannot read episodes: {error.filename}: {error.strerror}'
        ) from error
    return [leftover for leftover in found if leftover is not None]


def _leftover(path: Path, now_s: float) -> Leftover | None:
    name = durable.active_name(path)
    if name is None:
        return None
    try:
        files = list(path.iterdir())
        if any(durable.is_locked(file) for file in files):
            return None
        statuses = [file.stat() for file in files]
        written = max(status.st_mtime for status in statuses or [path.stat()])
    except FileNotFoundError:
        return None  # It was completed while we looked.
    return Leftover(
        name=name,
        path=path,
        size_bytes=sum(status.st_size for status in statuses),
        age_s=max(0.0, now_s - written),
    )
