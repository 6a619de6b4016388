"""The directory of episodes: names, numbers, and what earlier runs left behind."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from fetch_hand_sim.episode_log.errors import EpisodeExistsError, EpisodeLogError
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings
from fetch_hand_sim.episode_log.writer import EpisodeWriter

_NAME = re.compile(r'\.?(?P<task>.+)_(?P<index>\d+)_seed(?P<seed>\d+)(\.active)?')


def episode_name(task: str, index: int, seed: int) -> str:
    """Returns `<task>_<index>_seed<seed>`, with leading zeros so that names sort by number."""
    return f'{task}_{index:06d}_seed{seed}'


def next_index(directory: Path, task: str) -> int:
    """Returns the index after the largest of a task, counting cut-off episodes; 0 at first."""
    return max((int(name['index']) + 1 for name in _names(directory, task)), default=0)


def named_seeds(directory: Path, task: str) -> set[int]:
    """Returns the seeds of the episodes of a task in a directory, as their names say."""
    return {int(name['seed']) for name in _names(directory, task)}


def _names(directory: Path, task: str) -> Iterator[re.Match[str]]:
    if directory.is_dir():
        for path in directory.iterdir():
            if (name := _NAME.fullmatch(path.name)) and name['task'] == task:
                yield name


class EpisodeDirectory:
    """Begins one episode after the other in a directory.

    Numbers go on after what is there, so no run overwrites another. Several processes may share the
    directory: a name belongs to whoever creates its hidden directory first, the others take the
    next number.

    Args:
        path: The directory; created with the first episode.
        settings: How to write.
        namespace: ROS namespace of relative topic names.
    """

    def __init__(
        self, path: Path | str, settings: LogSettings | None = None, namespace: str = '/'
    ) -> None:
        self.path = Path(path)
        self._settings = settings
        self._namespace = namespace
        self._next: dict[str, int] = {}

    def begin(
        self,
        task: str,
        seed: int,
        metadata: Mapping[str, str],
        attachments: Sequence[Attachment] = (),
    ) -> EpisodeWriter:
        """Returns the writer of a new episode.

        Raises:
            EpisodeLogError: If it cannot be written, see `EpisodeWriter`.
        """
        index = self._next[task] if task in self._next else self._first_index(task)
        while True:
            name = episode_name(task, index, seed)
            try:
                writer = EpisodeWriter(
                    self.path, name, metadata, attachments, self._settings, self._namespace
                )
            except EpisodeExistsError:
                index += 1
            else:
                self._next[task] = index + 1
                return writer

    def _first_index(self, task: str) -> int:
        try:
            return next_index(self.path, task)
        except OSError as error:
            raise EpisodeLogError(
                f'cannot log episodes in {self.path}: {error.strerror}'
            ) from error
