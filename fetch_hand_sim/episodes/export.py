"""Logged episodes as datasets of the ecosystem: Parquet tables, Minari datasets.

Needs the extra `[data]`. Values are those of `load_episodes`, float64, unchanged.
"""

from __future__ import annotations

import copy
import importlib
import json
import os
import re
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from fetch_hand_sim.episode_log import EpisodeArrays
from fetch_hand_sim.gym_envs.registration import environment_id, register_environments
from fetch_hand_sim.gym_envs.spaces import observation_space
from msgs_spec.command_line import CommandError, UsageError, printable
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, task_spec

# Parts of a dataset's id become directories.
_DATASET_NAME = re.compile(r'[A-Za-z0-9][\w-]*(/[A-Za-z0-9][\w-]*)*', re.ASCII)
_VERSION = re.compile(r'-v\d+$')
# Minari's: where datasets live, and what is in the directories above one.
_MINARI_PATH, _NAMESPACE = 'MINARI_DATASETS_PATH', 'namespace_metadata.json'
_OBSERVATIONS = ('observation', 'achieved_goal', 'desired_goal')


class ExportError(CommandError):
    """A dataset cannot be written; the message is one line."""


def require(module: str) -> Any:
    """Imports what the extra `[data]` brings.

    Raises:
        ExportError: If it is missing; the line says how to install it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ExportError(
            f'{module.partition(".")[0]} is missing; install it with pip install '
            "'fetch_hand_sim[data]'"
        ) from error


def export_parquet(episodes: Sequence[EpisodeArrays], directory: Path) -> list[Path]:
    """Writes the episodes of one task as two tables.

    `<task>.parquet` has N + 1 rows per episode, one per observation: `episode_index`, `step`,
    `timestamp` in seconds since the reset, the three observations, then what happened after it:
    `action`, `command`, `reward`, `terminated`, `truncated`, `next_success`, all null in the last
    row. `<task>_episodes.parquet` has a row per episode: what the file says of itself.

    Args:
        episodes: At least one, all of one task.
        directory: Where to write.

    Returns:
        The two files.

    Raises:
        ExportError: If pyarrow is missing, or a file exists or cannot be written; none is created.
    """
    pyarrow, parquet = require('pyarrow'), require('pyarrow.parquet')
    task = episodes[0].spec.name
    tables = {
        directory / f'{task}.parquet': pyarrow.concat_tables(
            _step_table(pyarrow, index, episode) for index, episode in enumerate(episodes)
        ),
        directory / f'{task}_episodes.parquet': pyarrow.Table.from_pylist(
            [_episode_row(index, episode) for index, episode in enumerate(episodes)]
        ),
    }
    try:
        directory.mkdir(parents=True, exist_ok=True)
        for path in tables:
            if path.exists():
                raise ExportError(f'{path} exists; nothing is overwritten')
        _write_tables(parquet, tables)
    except OSError as error:
        raise ExportError(f'{directory}: {error.strerror or error}') from error
    return list(tables)


def _write_tables(parquet: Any, tables: Mapping[Path, Any]) -> None:
    """Writes all tables under hidden names, then gives them theirs: a full disk leaves none."""
    hidden = {path: path.with_name(f'.{path.name}.partial') for path in tables}
    try:
        for path, table in tables.items():
            with hidden[path].open('wb') as stream:
                parquet.write_table(table, stream, compression='zstd')
        for path in tables:
            os.replace(hidden[path], path)
    finally:
        for partial in hidden.values():
            partial.unlink(missing_ok=True)


def _step_table(pyarrow: Any, index: int, episode: EpisodeArrays) -> Any:
    rows = len(episode) + 1
    seconds = (episode.stamps - episode.stamps[0]) / 1e9
    columns = {
        'episode_index': pyarrow.array(np.full(rows, index)),
        'step': pyarrow.array(np.arange(rows)),
        'timestamp': pyarrow.array(seconds),
        **{name: _column(pyarrow, episode.observations[name], rows) for name in _OBSERVATIONS},
        'action': _column(pyarrow, episode.actions, rows),
        'command': _column(pyarrow, episode.commands, rows),
        'reward': _column(pyarrow, episode.rewards, rows),
        'terminated': _column(pyarrow, episode.terminated, rows),
        'truncated': _column(pyarrow, episode.truncated, rows),
        'next_success': _column(pyarrow, episode.success[1:], rows),
    }
    return pyarrow.table(columns)


def _column(pyarrow: Any, values: NDArray[Any], rows: int) -> Any:
    """A column of numbers, or of vectors of fixed size, filled up with nulls to `rows`."""
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
        'return': float(episode.rewards.sum()),
        'success': bool(episode.success[-1]),
        'complete': outcome.is_complete,
        'control_hz': record.control_hz,
        'metadata': json.dumps(episode.metadata),
        'result': json.dumps(episode.result),
    }


def export_minari(episodes: Sequence[EpisodeArrays], directory: Path, name: str) -> str:
    """Writes the episodes of one task as a Minari dataset.

    Args:
        episodes: At least one, all of one task.
        directory: Where Minari datasets live (`MINARI_DATASETS_PATH`).
        name: Of the dataset, such as `logged-v0` or `me/logged-v0`; the task comes before it, and a
            version after it if it has none.

    Returns:
        The id of the dataset, `<task>/<name>`.

    Raises:
        UsageError: If the name is not allowed.
        ExportError: If minari is missing, the dataset exists or cannot be written. No dataset is
            created in either case.
    """
    if not _DATASET_NAME.fullmatch(name):
        raise UsageError(
            f'dataset name {name!r}; allowed: letters, digits, _ and -, parts separated by /, such '
            'as logged-v0'
        )
    minari, collector = require('minari'), require('minari.data_collector')
    spec = episodes[0].spec
    dataset_id = f'{spec.name}/{name if _VERSION.search(name) else f"{name}-v0"}'
    if (directory / dataset_id).exists():
        raise ExportError(f'{directory / dataset_id} exists; nothing is overwritten')
    buffers = [
        collector.EpisodeBuffer(
            id=index,
            seed=episode.record.seed,
            observations=dict(episode.observations),
            actions=episode.actions,
            rewards=episode.rewards.tolist(),
            terminations=episode.terminated.tolist(),
            truncations=episode.truncated.tolist(),
            infos={'is_success': episode.success[:, None]},
        )
        for index, episode in enumerate(episodes)
    ]
    # Actions worked out from commands are not all float32.
    actions = spaces.Box(-1.0, 1.0, (spec.robot.action_size,), np.float64)
    try:
        directory.mkdir(parents=True, exist_ok=True)
        with _appearing(directory, dataset_id), warnings.catch_warnings():
            # Minari warns of every field that only an author could fill in.
            warnings.filterwarnings('ignore', module='minari')
            minari.create_dataset_from_buffers(
                dataset_id,
                buffers,
                env=_environment(episodes[0]),
                observation_space=observation_space(spec),
                action_space=actions,
                algorithm_name=_algorithm(episodes),
                description=f'Logged episodes of {spec.name}.',
                data_format='arrow',
                requirements=_requirements(episodes[0]),
            )
    except ImportError as error:
        raise ExportError(f"{error}; install with pip install 'fetch_hand_sim[data]'") from error
    except (OSError, ValueError, AssertionError) as error:
        raise ExportError(f'{dataset_id}: {" ".join(str(error).split())}') from error
    return dataset_id


@contextmanager
def _appearing(directory: Path, dataset_id: str) -> Iterator[None]:
    """Minari writes into a hidden folder meanwhile; what is whole at the end moves to its place."""
    # Minari joins a relative path to itself.
    directory = directory.resolve()
    with TemporaryDirectory(prefix='.', suffix='.partial', dir=directory) as hidden:
        os.environ[_MINARI_PATH] = hidden
        try:
            yield
        finally:
            os.environ[_MINARI_PATH] = str(directory)
        for source in Path(hidden).rglob(_NAMESPACE):
            target = directory / source.relative_to(hidden)
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists():
                source.replace(target)
        (Path(hidden) / dataset_id).rename(directory / dataset_id)


def _environment(episode: EpisodeArrays) -> Any:
    """The Gymnasium environment the episode could have come from, for `recover_environment`."""
    register_environments()
    record = episode.record
    spec = copy.deepcopy(gymnasium.spec(environment_id(episode.spec.name)))
    for name in ('reward_type', 'success_rule', 'control_hz'):
        spec.kwargs[name] = getattr(record, name)
    # Robots up to 1.0 took as many steps at every rate.
    rate = record.control_hz if record.timing == 'seconds' else DEFAULT_CONTROL_HZ
    spec.max_episode_steps = task_spec(episode.spec.name, control_hz=rate).episode_ticks
    return spec


def _algorithm(episodes: Sequence[EpisodeArrays]) -> str:
    checkpoints = {episode.metadata.get('checkpoint_sha256', 'unknown') for episode in episodes}
    return f'checkpoints {", ".join(sorted(checkpoints))}'


def _requirements(episode: EpisodeArrays) -> list[str]:
    names = ('mujoco', 'gymnasium-robotics')
    return [f'{name}=={episode.metadata.get(f"{name}_version", "unknown")}' for name in names]
