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
from collections.abc import Iterable, Iterator, Mapping, Sequence
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

# Parts of a dataset's id become directories.
_DATASET_NAME = re.compile(r'[A-Za-z0-9][\w-]*(/[A-Za-z0-9][\w-]*)*', re.ASCII)
_VERSION = re.compile(r'-v\d+$')
# Minari's: where datasets live, and what is in the directories above one.
_MINARI_PATH, _NAMESPACE = 'MINARI_DATASETS_PATH', 'namespace_metadata.json'
# Of a record, what `_environment` is made of.
_OF_THE_ENVIRONMENT = ('control_hz', 'timing', 'reward_type', 'success_rule')
_OBSERVATIONS = ('observation', 'achieved_goal', 'desired_goal')

ByTask = Mapping[str, Sequence[EpisodeArrays]]


class ExportError(CommandError):
    """A dataset cannot be written; the message is one line."""


def _require(module: str) -> Any:
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ExportError(
            f'{module.partition(".")[0]} is missing; install it with pip install '
            "'fetch_hand_sim[data]'"
        ) from error


def export_parquet(by_task: ByTask, directory: Path) -> dict[str, list[Path]]:
    """Writes the episodes of each task as two tables, all of them or none.

    `<task>.parquet` has N + 1 rows per episode, one per observation: `episode_index`, `step`,
    `timestamp` in seconds since the reset, the three observations, then what happened after it:
    `action`, `command`, `reward`, `terminated`, `truncated`, `next_success`, all null in the last
    row. `<task>_episodes.parquet` has a row per episode: what the file says of itself.

    Args:
        by_task: Episodes, at least one of each task.
        directory: Where to write.

    Returns:
        The two files of each task.

    Raises:
        ExportError: If pyarrow is missing, or a file exists or cannot be written; none is created.
    """
    pyarrow, parquet = _require('pyarrow'), _require('pyarrow.parquet')
    paths = {
        task: [directory / f'{task}.parquet', directory / f'{task}_episodes.parquet']
        for task in by_task
    }
    try:
        directory.mkdir(parents=True, exist_ok=True)
        _require_new(path for pair in paths.values() for path in pair)
        tables: dict[Path, Any] = {}
        for task, episodes in by_task.items():
            tables |= zip(paths[task], _tables(pyarrow, episodes), strict=True)
        _write_tables(parquet, tables)
    except OSError as error:
        raise ExportError(f'{directory}: {error.strerror or error}') from error
    return paths


def _require_new(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.exists():
            raise ExportError(f'{path} exists; nothing is overwritten')


def _tables(pyarrow: Any, episodes: Sequence[EpisodeArrays]) -> tuple[Any, Any]:
    """The steps of some episodes of one task, and the episodes."""
    steps = [_step_table(pyarrow, index, episode) for index, episode in enumerate(episodes)]
    rows = [_episode_row(index, episode) for index, episode in enumerate(episodes)]
    return pyarrow.concat_tables(steps), pyarrow.Table.from_pylist(rows)


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


def why_apart(episode: EpisodeArrays, first: EpisodeArrays) -> str:
    """Returns why an episode cannot be in the Minari dataset of another of its task, '' if it can.

    A dataset has one environment, whose rewards and rate are those of all its episodes.
    """
    one, other = episode.record, first.record
    for name in _OF_THE_ENVIRONMENT:
        if getattr(one, name) != getattr(other, name):
            return f'{name} {getattr(one, name)}, and {getattr(other, name)} in {first.path}'
    return ''


def export_minari(by_task: ByTask, directory: Path, name: str) -> dict[str, str]:
    """Writes the episodes of each task as a Minari dataset, all of them or none.

    Args:
        by_task: Episodes, at least one of each task, and none that is apart from the first of its
            task, see `why_apart`.
        directory: Where Minari datasets live (`MINARI_DATASETS_PATH`).
        name: Of the dataset, such as `logged-v0` or `me/logged-v0`; the task comes before it, and a
            version after it if it has none.

    Returns:
        The id of each task's dataset, `<task>/<name>`.

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
    minari, collector = _require('minari'), _require('minari.data_collector')
    versioned = name if _VERSION.search(name) else f'{name}-v0'
    ids = {task: f'{task}/{versioned}' for task in by_task}
    try:
        _require_new(directory / dataset_id for dataset_id in ids.values())
        directory.mkdir(parents=True, exist_ok=True)
        with _appearing(directory, list(ids.values())), warnings.catch_warnings():
            # Minari warns of every field that only an author could fill in.
            warnings.filterwarnings('ignore', module='minari')
            for task, episodes in by_task.items():
                _create_dataset(minari, collector, ids[task], episodes)
    except ImportError as error:
        raise ExportError(f"{error}; install with pip install 'fetch_hand_sim[data]'") from error
    except (OSError, ValueError, AssertionError) as error:
        raise ExportError(f'{directory}: {" ".join(str(error).split())}') from error
    return ids


def _create_dataset(
    minari: Any, collector: Any, dataset_id: str, episodes: Sequence[EpisodeArrays]
) -> None:
    """Writes a dataset where `MINARI_DATASETS_PATH` says."""
    spec = episodes[0].spec
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


@contextmanager
def _appearing(directory: Path, dataset_ids: Sequence[str]) -> Iterator[None]:
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
        for dataset_id in dataset_ids:
            (Path(hidden) / dataset_id).rename(directory / dataset_id)


def _environment(episode: EpisodeArrays) -> Any:
    """The Gymnasium environment the episode could have come from, for `recover_environment`."""
    register_environments()
    record = episode.record
    spec = copy.deepcopy(gymnasium.spec(environment_id(episode.spec.name)))
    for name in ('reward_type', 'success_rule', 'control_hz'):
        spec.kwargs[name] = getattr(record, name)
    spec.max_episode_steps = episode.spec.episode_ticks
    return spec


def _algorithm(episodes: Sequence[EpisodeArrays]) -> str:
    checkpoints = {episode.metadata.get('checkpoint_sha256', 'unknown') for episode in episodes}
    return f'checkpoints {", ".join(sorted(checkpoints))}'


def _requirements(episode: EpisodeArrays) -> list[str]:
    names = ('mujoco', 'gymnasium-robotics')
    return [f'{name}=={episode.metadata.get(f"{name}_version", "unknown")}' for name in names]
