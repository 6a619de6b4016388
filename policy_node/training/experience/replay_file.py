"""The newest episodes of a replay in a file. With them a resumed run learns at once."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from policy_node.training.experience.replay import EpisodeReplay, Episodes


def save_replay(path: Path, replay: EpisodeReplay, transitions: int) -> None:
    """Write the newest episodes of a replay, at least `transitions` transitions.

    Raises:
        OSError: If the file cannot be written; no partial file is left.
    """
    newest = replay.newest(-(-transitions // replay.ticks))
    tensors = {name: getattr(newest, name) for name in Episodes.__slots__}
    partial = path.with_name(f'.{path.name}.partial')
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        partial.touch()
        mode = partial.stat().st_mode
        save_file(tensors, partial)
        # safetensors lets only the owner read its files; the other files of a run follow umask.
        partial.chmod(mode)
        os.replace(partial, path)
    except (OSError, SafetensorError) as error:
        partial.unlink(missing_ok=True)
        raise OSError(f'{path} cannot be written: {error}') from None


def load_replay(path: Path, replay: EpisodeReplay) -> None:
    """Add the episodes of a file to a replay.

    Raises:
        ValueError: If the file cannot be read or does not fit.
    """
    try:
        tensors = load_file(path)
        episodes = Episodes(**{name: tensors[name] for name in Episodes.__slots__})
        _require_whole(episodes)
        replay.add(episodes.last(replay.capacity))
    except (OSError, SafetensorError, KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f'{path} is no replay of this run: {error}') from None


def _require_whole(episodes: Episodes) -> None:
    """Reject damaged episodes.

    Raises:
        ValueError: If a value is no finite float32 or the arrays have different lengths.
    """
    for name in Episodes.__slots__:
        array = getattr(episodes, name)
        if array.dtype != np.float32:
            raise ValueError(f'{name} is {array.dtype}, not float32')
        if array.shape[:1] != episodes.action.shape[:1]:
            raise ValueError(f'{name} is {array.shape}, action {episodes.action.shape}')
        if not np.isfinite(array).all():
            raise ValueError(f'{name} has a value that is not finite')
