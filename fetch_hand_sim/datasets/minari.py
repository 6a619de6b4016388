"""Write logged episodes as Minari datasets.

Needs `fetch_hand_sim[data]`. The datasets contain the unchanged float64 values of `load_episodes`.
"""

from __future__ import annotations

import copy
import os
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from fetch_hand_sim.datasets.writing import ByTask, ExportError, appearing
from fetch_hand_sim.episode_log import EpisodeArrays
from fetch_hand_sim.gym_envs.registration import environment_id, register_environments
from msgs_spec.tasks import DEFAULT_CONTROL_HZ
from msgs_spec.text import one_line
from node_runtime.command_line import UsageError, progress

# Parts of a dataset's id become directories.
_DATASET_NAME = re.compile(r'[A-Za-z0-9][\w-]*(/[A-Za-z0-9][\w-]*)*', re.ASCII)
_VERSION = re.compile(r'-v\d+$')
# Variable with the folder of Minari's datasets, and the file in each folder above a dataset.
_MINARI_PATH, _NAMESPACE = 'MINARI_DATASETS_PATH', 'namespace_metadata.json'


def dataset_name(text: str) -> str:
    """Return `text` as a dataset name, with `-v0` if it has no version; UsageError if invalid."""
    *folders, _ = text.split('/')
    # A folder with a version is a dataset, and Minari finds no dataset within it.
    if not _DATASET_NAME.fullmatch(text) or any(map(_VERSION.search, folders)):
        raise UsageError(
            f'dataset name {text!r}; allowed: letters, digits, _ and -, parts separated by /, a '
            'version in the last alone, such as me/logged-v0'
        )
    return text if _VERSION.search(text) else f'{text}-v0'


def export_minari(by_task: ByTask, directory: Path, name: str) -> dict[str, str]:
    """Write one Minari dataset for each task.

    Args:
        by_task: Episodes by task, at least one each. Episodes of one task have the same control
            rate, timing, reward type and success rule.
        directory: Folder of the Minari datasets (`MINARI_DATASETS_PATH`).
        name: Name such as `logged-v0` or `me/logged-v0`; the task comes before it.

    Returns:
        The id of the dataset, `<task>/<name>`, by task.

    Raises:
        UsageError: If the name is not allowed.
        ExportError: If a dataset exists or cannot be written. Then no dataset is created.
    """
    versioned = dataset_name(name)
    for task in by_task:
        if not _DATASET_NAME.fullmatch(task):
            raise ExportError(f'Minari takes no dataset of a task that is called {task!r}')
    ids = {task: f'{task}/{versioned}' for task in by_task}
    count = sum(map(len, by_task.values()))
    try:
        with _minari_folder(directory, ids.values()), progress('written', count) as advance:
            for task, episodes in by_task.items():
                _create_dataset(ids[task], episodes, advance)
    except (ValueError, AssertionError) as error:
        raise ExportError(f'{directory}: {one_line(error, longest=1000)}') from error
    return ids


def _buffers(episodes: Sequence[EpisodeArrays], advance: Callable[[int], None]) -> Iterator[Any]:
    """Yield each episode as an `EpisodeBuffer` of Minari; then call `advance(1)`."""
    from minari.data_collector import EpisodeBuffer

    for index, episode in enumerate(episodes):
        yield EpisodeBuffer(
            id=index,
            seed=episode.record.seed,
            observations=dict(episode.observations),
            actions=episode.actions,
            rewards=episode.rewards.tolist(),
            terminations=episode.terminated.tolist(),
            truncations=episode.truncated.tolist(),
            infos={'is_success': episode.success[:, None]},
        )
        advance(1)


def _create_dataset(
    dataset_id: str, episodes: Sequence[EpisodeArrays], advance: Callable[[int], None]
) -> None:
    """Write a dataset into the folder MINARI_DATASETS_PATH; call `advance(1)` per episode."""
    import minari

    # Loads MuJoCo, which other exports do not need.
    from fetch_hand_sim.gym_envs.task_attributes import observation_space

    spec = episodes[0].spec
    # Actions computed from commands may need float64.
    actions = spaces.Box(-1.0, 1.0, (spec.robot.action_size,), np.float64)
    with _unmeasured():
        dataset = minari.create_dataset_from_buffers(
            dataset_id,
            _buffers(episodes, advance),
            env=_environment(episodes[0]),
            observation_space=observation_space(spec),
            action_space=actions,
            algorithm_name=_algorithm(episodes),
            description=_description(episodes[0]),
            data_format='arrow',
            requirements=_requirements(episodes[0]),
        )
    # This measures the dataset, too.
    complete = [{'complete': episode.is_complete} for episode in episodes]
    dataset.storage.update_episode_metadata(complete)


@contextmanager
def _unmeasured() -> Iterator[None]:
    """Stop Minari from adding up all file sizes after every episode, until the block ends."""
    from minari.dataset.minari_storage import MinariStorage

    measure = MinariStorage.get_size
    MinariStorage.get_size = lambda dataset: 0.0
    try:
        yield
    finally:
        MinariStorage.get_size = measure


@contextmanager
def _minari_folder(directory: Path, dataset_ids: Iterable[str]) -> Iterator[None]:
    """Let Minari write into a hidden folder; move its datasets to `directory` on success."""
    # Minari joins a relative path to itself.
    directory, before = directory.resolve(), os.environ.get(_MINARI_PATH)
    with appearing(directory, dataset_ids) as hidden:
        os.environ[_MINARI_PATH] = str(hidden)
        try:
            with warnings.catch_warnings():
                # Minari warns about every field that only an author can fill in.
                warnings.filterwarnings('ignore', module='minari')
                yield
        finally:
            if before is None:
                del os.environ[_MINARI_PATH]
            else:
                os.environ[_MINARI_PATH] = before
        for source in hidden.rglob(_NAMESPACE):
            target = directory / source.relative_to(hidden)
            target.parent.mkdir(parents=True, exist_ok=True)
            if not target.exists():
                source.replace(target)


def _environment(episode: EpisodeArrays) -> Any:
    """Return the Gymnasium `EnvSpec` of an episode, for Minari's `recover_environment`."""
    register_environments()
    record = episode.record
    spec = copy.deepcopy(gymnasium.spec(environment_id(episode.spec.name)))
    for name in ('reward_type', 'success_rule', 'control_hz'):
        spec.kwargs[name] = getattr(record, name)
    if not record.disturbances.is_off:
        spec.kwargs['disturbances'] = record.disturbances.as_dict()
    spec.max_episode_steps = episode.spec.episode_ticks
    return spec


def _description(episode: EpisodeArrays) -> str:
    text = f'Logged episodes of {episode.spec.name}.'
    if episode.record.timing == 'ticks' and episode.record.control_hz != DEFAULT_CONTROL_HZ:
        text += (
            ' They are of a robot of version 1.0, whose gripper moved so far per tick at any rate; '
            'in the environment it moves so far per second.'
        )
    return text


def _algorithm(episodes: Sequence[EpisodeArrays]) -> str:
    checkpoints = {episode.metadata.get('checkpoint_sha256', 'unknown') for episode in episodes}
    return f'checkpoints {", ".join(sorted(checkpoints))}'


def _requirements(episode: EpisodeArrays) -> list[str]:
    names = ('mujoco', 'gymnasium-robotics')
    return [f'{name}=={episode.metadata.get(f"{name}_version", "unknown")}' for name in names]
