"""Logged episodes as a LeRobot dataset, format 3.0: what imitation learning on robots reads.

Needs pyarrow (the extra `[data]`), not lerobot itself, whose pins exclude other packages' torch.
Layout, names and types are those of `LeRobotDataset.create` and `save_episode` in lerobot 0.4.4.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.episode_log import EpisodeArrays
from fetch_hand_sim.episodes.export import ExportError, require
from msgs_spec.tasks import TaskSpec

_VERSION = 'v3.0'
_FILES_PER_CHUNK = 1000
# Uncompressed, as `data_files_size_in_mb` of `meta/info.json` says; and that of films, of which
# there are none.
_FILE_MEGABYTES, _FILM_MEGABYTES = 100, 200
_FILE = 'chunk-{chunk_index:03d}/file-{file_index:03d}.parquet'
_QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
_OBJECT = 'object'

Columns = dict[str, NDArray[Any]]


def export_lerobot(episodes: Sequence[EpisodeArrays], directory: Path) -> Path:
    """Writes the episodes of one task as a dataset of N frames each, one per action.

    A frame is `observation.state`, what is observed of the robot; `observation.environment_state`,
    what is observed of the object, then the desired goal; `action`; and what came of it,
    `next.reward`, `next.success` and `next.done`. All float32, as LeRobot's policies take them.

    Args:
        episodes: At least one, all of one task and one rate, each with at least one step.
        directory: Where to write.

    Returns:
        The dataset, `directory/<task>`: `LeRobotDataset('me/<task>', root=...)`.

    Raises:
        ExportError: If pyarrow is missing, rates differ, or the dataset exists or cannot be
            written; none is created.
    """
    require('pyarrow.parquet')
    spec = episodes[0].spec
    rates = sorted({episode.record.control_hz for episode in episodes})
    if len(rates) > 1:
        found = ', '.join(f'{rate:g}' for rate in rates)
        raise ExportError(f'{spec.name}: episodes at {found} Hz; a LeRobot dataset has one rate')
    target = directory / spec.name
    if target.exists():
        raise ExportError(f'{target} exists; nothing is overwritten')
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(prefix='.', suffix='.partial', dir=directory) as hidden:
            dataset = Path(hidden) / spec.name
            _write(dataset, spec, rates[0], [_frames(episode) for episode in episodes])
            dataset.rename(target)
    except OSError as error:
        raise ExportError(f'{target}: {error.strerror or error}') from error
    return target


def features(spec: TaskSpec) -> dict[str, dict[str, Any]]:
    """The columns of a task's dataset as `meta/info.json` has them: type, shape, names."""
    robot, rest = _parts(spec)
    goal = [f'desired_goal_{index}' for index in range(spec.goal.size)]
    commands = [part.name for part in spec.robot.command]
    return {
        'observation.state': _feature('float32', robot),
        'observation.environment_state': _feature('float32', rest + goal),
        'action': _feature('float32', commands),
        'next.reward': _feature('float32'),
        'next.success': _feature('bool'),
        'next.done': _feature('bool'),
        'timestamp': _feature('float32'),
        **{
            name: _feature('int64')
            for name in ('frame_index', 'episode_index', 'index', 'task_index')
        },
    }


def _feature(dtype: str, names: list[str] | None = None) -> dict[str, Any]:
    return {'dtype': dtype, 'shape': [len(names) if names else 1], 'names': names}


def _parts(spec: TaskSpec) -> tuple[list[str], list[str]]:
    """Names of the observed numbers of the robot, and of its object."""
    robot: list[str] = []
    rest: list[str] = []
    for part in spec.observation:
        into = rest if part.name.startswith(_OBJECT) else robot
        into += [f'{part.name}_{index}' for index in range(part.size)]
    return robot, rest


def _frames(episode: EpisodeArrays) -> Columns:
    """One episode's columns, but for what counts frames over the whole dataset."""
    spec, count = episode.spec, len(episode)
    seen = episode.observations['observation'][:count]
    of_object = np.repeat(
        [part.name.startswith(_OBJECT) for part in spec.observation],
        [part.size for part in spec.observation],
    )
    environment = [seen[:, of_object], episode.observations['desired_goal'][:count]]
    frame = np.arange(count)
    return {
        'observation.state': seen[:, ~of_object].astype(np.float32),
        'observation.environment_state': np.concatenate(environment, axis=1).astype(np.float32),
        'action': episode.actions.astype(np.float32),
        'next.reward': episode.rewards.astype(np.float32),
        'next.success': episode.success[1:],
        'next.done': episode.terminated | episode.truncated,
        'timestamp': (frame / episode.record.control_hz).astype(np.float32),
        'frame_index': frame,
    }


def _write(dataset: Path, spec: TaskSpec, rate: float, episodes: list[Columns]) -> None:
    pyarrow, parquet = require('pyarrow'), require('pyarrow.parquet')
    rows = _write_frames(dataset, spec, episodes)
    path = _created(dataset / 'meta' / 'episodes' / _FILE.format(chunk_index=0, file_index=0))
    parquet.write_table(pyarrow.Table.from_pylist(rows), path, compression='snappy')
    parquet.write_table(_tasks(pyarrow, spec), dataset / 'meta' / 'tasks.parquet')
    statistics = {
        name: _statistics(np.concatenate([columns[name] for columns in episodes]))
        for name in features(spec)
    }
    _write_json(dataset / 'meta' / 'stats.json', statistics)
    frames = rows[-1]['dataset_to_index']
    _write_json(dataset / 'meta' / 'info.json', _info(spec, rate, len(rows), frames))


def _write_frames(dataset: Path, spec: TaskSpec, episodes: list[Columns]) -> list[dict[str, Any]]:
    """Writes the frames, counted over the whole dataset; returns a row for each episode."""
    pyarrow, parquet = require('pyarrow'), require('pyarrow.parquet')
    rows: list[dict[str, Any]] = []
    total = 0
    for number, group in enumerate(_files(episodes)):
        chunk, file = divmod(number, _FILES_PER_CHUNK)
        where = {'chunk_index': chunk, 'file_index': file}
        tables = []
        for columns in group:
            count = len(columns['frame_index'])
            columns['episode_index'] = np.full(count, len(rows))
            columns['index'] = np.arange(total, total + count)
            columns['task_index'] = np.zeros(count, dtype=np.int64)
            tables.append(pyarrow.table({n: _column(pyarrow, v) for n, v in columns.items()}))
            rows.append(_episode_row(spec, columns, where, len(rows)))
            total += count
        path = _created(dataset / 'data' / _FILE.format(**where))
        parquet.write_table(pyarrow.concat_tables(tables), path, compression='snappy')
    return rows


def _files(episodes: list[Columns]) -> Iterator[list[Columns]]:
    """The episodes, file by file."""
    group: list[Columns] = []
    size = 0
    for columns in episodes:
        more = sum(values.nbytes for values in columns.values())
        if group and size + more > _FILE_MEGABYTES * 2**20:
            yield group
            group, size = [], 0
        group.append(columns)
        size += more
    yield group


def _column(pyarrow: Any, values: NDArray[Any]) -> Any:
    """Numbers, or vectors of fixed size; a vector of one number is that number."""
    flat = pyarrow.array(values.ravel())
    if values.ndim == 1 or values.shape[1] == 1:
        return flat
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _episode_row(
    spec: TaskSpec, columns: Columns, where: dict[str, int], number: int
) -> dict[str, Any]:
    index = columns['index']
    return {
        'episode_index': number,
        'tasks': [spec.name],
        'length': len(index),
        **{f'data/{name}': value for name, value in where.items()},
        'dataset_from_index': int(index[0]),
        'dataset_to_index': int(index[-1]) + 1,
        **{
            f'stats/{name}/{kind}': value
            for name, values in columns.items()
            for kind, value in _statistics(values).items()
        },
        'meta/episodes/chunk_index': 0,
        'meta/episodes/file_index': 0,
    }


def _statistics(values: NDArray[Any]) -> dict[str, list[float] | list[bool] | list[int]]:
    """What policies normalise with, of frames (n,) or (n, size); each a list."""
    rows = values.reshape(len(values), -1)
    numbers = rows.astype(np.float64)
    quantiles = np.quantile(numbers, _QUANTILES, axis=0)
    return {
        'min': rows.min(axis=0).tolist(),
        'max': rows.max(axis=0).tolist(),
        'mean': numbers.mean(axis=0).tolist(),
        'std': numbers.std(axis=0).tolist(),
        'count': [len(rows)],
        **{
            f'q{round(100 * share):02d}': quantile.tolist()
            for share, quantile in zip(_QUANTILES, quantiles, strict=True)
        },
    }


def _tasks(pyarrow: Any, spec: TaskSpec) -> Any:
    """The one task; pandas reads the names as the index of the table."""
    names = '__index_level_0__'
    number = {'pandas_type': 'int64', 'numpy_type': 'int64', 'metadata': None}
    name = {'pandas_type': 'unicode', 'numpy_type': 'object', 'metadata': None}
    pandas = {
        'index_columns': [names],
        'column_indexes': [],
        'columns': [
            {'name': 'task_index', 'field_name': 'task_index', **number},
            {'name': None, 'field_name': names, **name},
        ],
        'pandas_version': '2.2.3',
    }
    table = pyarrow.table({'task_index': [0], names: [spec.name]})
    return table.replace_schema_metadata({'pandas': json.dumps(pandas)})


def _info(spec: TaskSpec, rate: float, episodes: int, frames: int) -> dict[str, Any]:
    return {
        'codebase_version': _VERSION,
        'robot_type': spec.robot.name,
        'total_episodes': episodes,
        'total_frames': frames,
        'total_tasks': 1,
        'chunks_size': _FILES_PER_CHUNK,
        'data_files_size_in_mb': _FILE_MEGABYTES,
        'video_files_size_in_mb': _FILM_MEGABYTES,
        'fps': int(rate) if rate == int(rate) else rate,
        'splits': {'train': f'0:{episodes}'},
        'data_path': f'data/{_FILE}',
        'video_path': None,
        'features': features(spec),
    }


def _created(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def _write_json(path: Path, value: Any) -> None:
    path.write_text(json.dumps(value, indent=4, ensure_ascii=False), encoding='utf-8')
