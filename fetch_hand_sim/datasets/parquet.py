"""Write logged episodes as Parquet tables.

Needs the extra `[data]`. The tables contain the unchanged float64 values of `load_episodes`.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from pyarrow import parquet

from fetch_hand_sim.datasets.writing import ByTask, appearing
from fetch_hand_sim.episode_log import EpisodeArrays
from msgs_spec.text import printable

_OBSERVATIONS = ('observation', 'achieved_goal', 'desired_goal')


def export_parquet(by_task: ByTask, directory: Path) -> dict[str, list[Path]]:
    """Write two tables for each task; return the paths of the two files by task.

    `<task>.parquet` has N + 1 rows for an episode of N steps, one per observation. The first
    columns are `episode_index`, `step`, `timestamp` in seconds since the reset, `observation`,
    `achieved_goal` and `desired_goal`. The columns `action`, `command`, `reward`, `terminated`,
    `truncated` and `next_success` belong to the step that follows this observation. They are null
    in the last row of an episode.
    `<task>_episodes.parquet` has a row per episode with its metadata and result.

    Raises:
        ExportError: If a file exists or cannot be written. Then no file is created.
    """
    names = {task: (f'{task}.parquet', f'{task}_episodes.parquet') for task in by_task}
    with appearing(directory, chain(*names.values())) as hidden:
        for task, episodes in by_task.items():
            for name, table in zip(names[task], _tables(episodes), strict=True):
                with (hidden / name).open('wb') as stream:
                    parquet.write_table(table, stream, compression='zstd')
    return {task: [directory / name for name in pair] for task, pair in names.items()}


def _tables(episodes: Sequence[EpisodeArrays]) -> tuple[Any, Any]:
    """Return the table of all steps and the table of all episodes of one task."""
    steps = [_step_table(index, episode) for index, episode in enumerate(episodes)]
    rows = [_episode_row(index, episode) for index, episode in enumerate(episodes)]
    return pyarrow.concat_tables(steps), pyarrow.Table.from_pylist(rows)


def _step_table(index: int, episode: EpisodeArrays) -> Any:
    rows = len(episode) + 1
    seconds = (episode.stamps - episode.stamps[0]) / 1e9
    columns = {
        'episode_index': pyarrow.array(np.full(rows, index)),
        'step': pyarrow.array(np.arange(rows)),
        'timestamp': pyarrow.array(seconds),
        **{name: _column(episode.observations[name], rows) for name in _OBSERVATIONS},
        'action': _column(episode.actions, rows),
        'command': _column(episode.commands, rows),
        'reward': _column(episode.rewards, rows),
        'terminated': _column(episode.terminated, rows),
        'truncated': _column(episode.truncated, rows),
        'next_success': _column(episode.success[1:], rows),
    }
    return pyarrow.table(columns)


def _column(values: NDArray[Any], rows: int) -> Any:
    """Convert an array (n,) or (n, size) to an Arrow column, extended with nulls to `rows`."""
    column = pyarrow.array(values.ravel())
    if values.ndim == 2:
        column = pyarrow.FixedSizeListArray.from_arrays(column, values.shape[1])
    return pyarrow.concat_arrays([column, pyarrow.nulls(rows - len(values), column.type)])


def _episode_row(index: int, episode: EpisodeArrays) -> dict[str, Any]:
    record, outcome = episode.record, episode.outcome
    return {
        'episode_index': index,
        'path': printable(str(episode.path)),
        'task': episode.spec.name,
        'seed': record.seed,
        'steps': len(episode),
        # The records of a cut-off episode may lack them.
        'return': _first(outcome.episode_return, sum(episode.rewards.tolist())),
        'success': _first(outcome.is_success, bool(episode.success[-1])),
        'complete': outcome.is_complete,
        'control_hz': record.control_hz,
        'metadata': json.dumps(episode.metadata),
        'result': json.dumps(episode.result),
    }


def _first(said: Any, found: Any) -> Any:
    return found if said is None else said
