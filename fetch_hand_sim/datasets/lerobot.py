"""Write logged episodes as a LeRobot dataset, format 3.0, for imitation learning.

Needs pyarrow (the extra `[data]`) but not lerobot, which restricts the version of torch. The files
equal those that `LeRobotDataset.create` and `save_episode` of lerobot 0.4.4 write.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from itertools import accumulate
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow
from numpy.typing import NDArray
from pyarrow import parquet

from fetch_hand_sim.datasets.writing import ByTask, appearing
from fetch_hand_sim.episode_log import EpisodeArrays
from fetch_hand_sim.films.film import write_film
from fetch_hand_sim.films.recording import Studio, recording_of
from msgs_spec.arrays import Picture
from msgs_spec.tasks import TaskSpec

_VERSION = 'v3.0'
_FILES_PER_CHUNK = 1000
# Uncompressed, as `meta/info.json` records; films are not measured.
_FILE_MEGABYTES, _FILM_MEGABYTES = 100, 200
_FILE = 'chunk-{chunk_index:03d}/file-{file_index:03d}'
_DATA, _FILM = f'data/{_FILE}.parquet', f'videos/{{video_key}}/{_FILE}.mp4'
_EPISODES = f'meta/episodes/{_FILE}.parquet'

Row = dict[str, Any]


def export_lerobot(
    by_task: ByTask, directory: Path, camera: Camera | None = None
) -> dict[str, Path]:
    """Write one dataset for each task; an episode of N steps has N frames.

    A frame has `observation.state` (the robot), `observation.environment_state` (the object, then
    the desired goal), `action`, and its results `next.reward`, `next.success` and `next.done`.
    Observations, actions and rewards are float32, as LeRobot's policies expect.

    Args:
        by_task: One or more episodes of each task, with one or more steps. The episodes of a
            task have the same control rate, timing, reward type and success rule.
        camera: Camera of the films; None writes no films.

    Returns:
        The folder of each dataset by task, for `LeRobotDataset('me/<task>', root=folder)`.

    Raises:
        ExportError: If a dataset exists or cannot be written. Then no dataset is created.
        ValueError: If a model has no such camera, or ffmpeg is missing for a film.
        RuntimeError: If there is no OpenGL to draw with.
    """
    with appearing(directory, by_task) as hidden:
        for task, episodes in by_task.items():
            rate = episodes[0].record.control_hz
            _Dataset(hidden / task, episodes[0].spec, rate, camera).write(episodes)
    return {task: directory / task for task in by_task}


@dataclass(frozen=True, slots=True)
class _Dataset:
    """Writes the LeRobot dataset of one task into the folder `path`, `rate` frames per second."""

    path: Path
    spec: TaskSpec
    rate: float
    camera: Camera | None

    def write(self, episodes: Sequence[EpisodeArrays]) -> None:
        begins = accumulate((len(episode) for episode in episodes), initial=0)
        columns = [
            frames(episode, number, begin)
            for number, (episode, begin) in enumerate(zip(episodes, begins, strict=False))
        ]
        rows: list[Row] = []
        colors: list[Histogram] = []
        for number, group in enumerate(_files(columns)):
            chunk, file = divmod(number, _FILES_PER_CHUNK)
            where = {'chunk_index': chunk, 'file_index': file}
            tables = [pyarrow.table({n: _column(v) for n, v in each.items()}) for each in group]
            parquet.write_table(pyarrow.concat_tables(tables), self._file(_DATA, **where))
            added = [self._row(each, where) for each in group]
            if self.camera is not None:
                shown = [episodes[row['episode_index']] for row in added]
                colors += self._film(self.camera, shown, added, where)
            rows += added
        table = pyarrow.Table.from_pylist(rows)
        parquet.write_table(table, self._file(_EPISODES, chunk_index=0, file_index=0))
        parquet.write_table(_tasks(self.spec), self._file('meta/tasks.parquet'))
        self._write_json('meta/stats.json', self._statistics(columns, colors))
        self._write_json('meta/info.json', self._info(rows))

    def _row(self, columns: Columns, where: dict[str, int]) -> Row:
        """Return the row of an episode in `meta/episodes`; `where` has chunk and file index."""
        index = columns['index']
        return {
            'episode_index': int(columns['episode_index'][0]),
            'tasks': [self.spec.name],
            'length': len(index),
            **{f'data/{name}': value for name, value in where.items()},
            'dataset_from_index': int(index[0]),
            'dataset_to_index': int(index[-1]) + 1,
            **_flat({name: statistics(values) for name, values in columns.items()}),
            'meta/episodes/chunk_index': 0,
            'meta/episodes/file_index': 0,
        }

    def _film(
        self,
        camera: Camera,
        episodes: Sequence[EpisodeArrays],
        rows: Sequence[Row],
        where: dict[str, int],
    ) -> list[Histogram]:
        """Write the episodes of one data file as one film; return a colour histogram of each.

        Add to the row of each episode the chunk and file index of the film (`where`), its start and
        end time in the film, and the statistics of its colours.
        """
        path = self._file(_FILM, video_key=camera.key, **where)
        colors = write_episodes(path, episodes, camera, self.rate)
        begins = accumulate((row['length'] for row in rows), initial=0)
        for row, begin, histogram in zip(rows, begins, colors, strict=False):
            end = begin + row['length']
            says = {'from_timestamp': begin / self.rate, 'to_timestamp': end / self.rate}
            row |= {f'videos/{camera.key}/{name}': value for name, value in (where | says).items()}
            row |= _flat({camera.key: color_statistics(histogram, camera.width * camera.height)})
        return colors

    def _statistics(self, columns: Sequence[Columns], colors: Sequence[Histogram]) -> Row:
        found = {
            name: statistics(np.concatenate([each[name] for each in columns]))
            for name in features(self.spec)
        }
        if self.camera is not None:
            pixels = self.camera.width * self.camera.height
            found[self.camera.key] = color_statistics(np.sum(colors, axis=0), pixels)
        return found

    def _info(self, rows: Sequence[Row]) -> Row:
        camera, rate = self.camera, self.rate
        fps = int(rate) if rate == int(rate) else rate
        return {
            'codebase_version': _VERSION,
            'robot_type': self.spec.robot.name,
            'total_episodes': len(rows),
            'total_frames': rows[-1]['dataset_to_index'],
            'total_tasks': 1,
            'chunks_size': _FILES_PER_CHUNK,
            'data_files_size_in_mb': _FILE_MEGABYTES,
            'video_files_size_in_mb': _FILM_MEGABYTES,
            'fps': fps,
            'splits': {'train': f'0:{len(rows)}'},
            'data_path': _DATA,
            'video_path': None if camera is None else _FILM,
            'features': {
                **({} if camera is None else {camera.key: camera.feature(fps)}),
                **features(self.spec),
            },
        }

    def _file(self, pattern: str, **fields: Any) -> Path:
        path = self.path / pattern.format(**fields)
        path.parent.mkdir(parents=True, exist_ok=True)
        return path

    def _write_json(self, name: str, value: Any) -> None:
        text = json.dumps(value, indent=4, ensure_ascii=False)
        self._file(name).write_text(text, encoding='utf-8')


def _files(episodes: Sequence[Columns]) -> Iterator[list[Columns]]:
    """Yield groups of episodes, each small enough for one data file."""
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


def _column(values: NDArray[Any]) -> Any:
    """Convert an array to an Arrow column of numbers, or of lists of fixed size for (n, size)."""
    flat = pyarrow.array(values.ravel())
    if values.ndim == 1 or values.shape[1] == 1:
        return flat
    return pyarrow.FixedSizeListArray.from_arrays(flat, values.shape[1])


def _flat(found: Row) -> Row:
    """Flatten statistics {column: {kind: value}} to the entries `stats/<column>/<kind>`."""
    return {
        f'stats/{name}/{kind}': value
        for name, kinds in found.items()
        for kind, value in kinds.items()
    }


def _tasks(spec: TaskSpec) -> Any:
    """Return the Arrow table `meta/tasks`: one row, whose index in pandas is the task name."""
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


# Columns; names and types are those of lerobot 0.4.4 (`utils/constants.py`, `datasets/utils.py`)

Columns = dict[str, NDArray[Any]]

QUANTILES = {'q01': 0.01, 'q10': 0.10, 'q50': 0.50, 'q90': 0.90, 'q99': 0.99}
# Beginning of the names of observed parts that do not belong to the robot.
_OBJECT = 'object'
# Numbers of frames, episodes and tasks.
_COUNTS = ('frame_index', 'episode_index', 'index', 'task_index')


def features(spec: TaskSpec) -> dict[str, dict[str, Any]]:
    """Return type, shape and value names of each column, as `meta/info.json` contains them."""
    robot, rest = _parts(spec)
    goal = [f'desired_goal_{index}' for index in range(spec.goal.size)]
    return {
        'observation.state': _feature('float32', robot),
        'observation.environment_state': _feature('float32', rest + goal),
        'action': _feature('float32', [part.name for part in spec.robot.command]),
        'next.reward': _feature('float32'),
        'next.success': _feature('bool'),
        'next.done': _feature('bool'),
        'timestamp': _feature('float32'),
        **{name: _feature('int64') for name in _COUNTS},
    }


def _feature(dtype: str, names: list[str] | None = None) -> dict[str, Any]:
    return {'dtype': dtype, 'shape': [len(names) if names else 1], 'names': names}


def _parts(spec: TaskSpec) -> tuple[list[str], list[str]]:
    """Return the names of the observed values of the robot, then of those of the object."""
    robot: list[str] = []
    rest: list[str] = []
    for part in spec.observation:
        into = rest if part.name.startswith(_OBJECT) else robot
        into += [f'{part.name}_{index}' for index in range(part.size)]
    return robot, rest


def frames(episode: EpisodeArrays, episode_index: int, first_index: int) -> Columns:
    """Return the columns of the N frames of an episode, one frame per action.

    `episode_index` and `first_index` number the episode and its first frame in the dataset.
    """
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
        'episode_index': np.full(count, episode_index),
        'index': first_index + frame,
        'task_index': np.zeros_like(frame),
    }


def statistics(values: NDArray[Any]) -> dict[str, Any]:
    """Return min, max, mean, std, count and `QUANTILES` by name for a column (n,) or (n, size)."""
    rows = values.reshape(len(values), -1)
    numbers = rows.astype(np.float64)
    return {
        'min': rows.min(axis=0).tolist(),
        'max': rows.max(axis=0).tolist(),
        'mean': numbers.mean(axis=0).tolist(),
        'std': numbers.std(axis=0).tolist(),
        'count': [len(rows)],
        **{name: np.quantile(numbers, share, axis=0).tolist() for name, share in QUANTILES.items()},
    }


# Films: every frame of the episodes, drawn from the log

_LEVELS = 256
# Pictures from one keyframe to the next, as lerobot encodes films.
_KEYFRAME_EVERY = 2

Histogram = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Camera:
    """The camera of the films of a dataset.

    Attributes:
        width: Width of pictures, pixels, an even number for H.264.
        height: Height of pictures, pixels, an even number for H.264.
        name: Name of a camera of the model; None for the usual view.
    """

    width: int
    height: int
    name: str | None = None

    @property
    def key(self) -> str:
        """The name of the dataset's column with the pictures of this camera."""
        return f'observation.images.{self.name or "scene"}'

    def feature(self, rate: float) -> dict[str, Any]:
        """Return the entry of the column `key` in `meta/info.json`; `rate` is frames per second."""
        return {
            'dtype': 'video',
            'shape': [self.height, self.width, 3],
            'names': ['height', 'width', 'channels'],
            'info': {
                'video.height': self.height,
                'video.width': self.width,
                'video.codec': 'h264',
                'video.pix_fmt': 'yuv420p',
                'video.is_depth_map': False,
                'video.fps': rate,
                'video.channels': 3,
                'has_audio': False,
            },
        }


def write_episodes(
    path: Path, episodes: Sequence[EpisodeArrays], camera: Camera, rate: float
) -> list[Histogram]:
    """Write several episodes as one film, each without its last frame, which has no action.

    Returns:
        A histogram (3, 256) of each episode: number of pixels by colour channel and level.
    """
    histograms = [np.zeros((3, _LEVELS), dtype=np.int64) for _ in episodes]
    with closing(Studio(camera.width, camera.height, camera.name)) as studio:
        pictures = _counted(studio, episodes, histograms)
        write_film(path, pictures, rate, keyframe_every=_KEYFRAME_EVERY)
    return histograms


def _counted(
    studio: Studio, episodes: Sequence[EpisodeArrays], histograms: Sequence[Histogram]
) -> Iterator[Picture]:
    for episode, histogram in zip(episodes, histograms, strict=True):
        recording = recording_of(episode)
        for index in range(len(recording.frames) - 1):
            picture = studio.plain(recording, index)
            for channel, row in enumerate(histogram):
                row += np.bincount(picture[..., channel].ravel(), minlength=_LEVELS)
            yield picture


def color_statistics(histogram: Histogram, pixels: int) -> dict[str, Any]:
    """Return the statistics of pictures per colour channel, (3, 1, 1), with levels in [0, 1].

    Args:
        histogram: (3, 256) number of pixels by colour channel and level.
        pixels: Number of pixels of a picture, to compute `count`, the number of pictures.
    """
    levels = np.arange(_LEVELS) / (_LEVELS - 1)
    total = int(histogram[0].sum())
    share = histogram / total
    mean = share @ levels
    drawn, below = histogram > 0, np.cumsum(histogram, axis=1)
    found = {
        'min': levels[drawn.argmax(axis=1)],
        'max': levels[_LEVELS - 1 - drawn[:, ::-1].argmax(axis=1)],
        'mean': mean,
        'std': np.sqrt(np.maximum(share @ levels**2 - mean**2, 0.0)),
        **{
            name: levels[(below >= share * total).argmax(axis=1)]
            for name, share in QUANTILES.items()
        },
    }
    values = {name: each.reshape(3, 1, 1).tolist() for name, each in found.items()}
    return {**values, 'count': [total // pixels]}
