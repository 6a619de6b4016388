"""The columns of a LeRobot dataset, and their statistics for normalisation.

Names and types are those of lerobot 0.4.4 (`lerobot/utils/constants.py`, `datasets/utils.py`).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.episode_log import EpisodeArrays
from msgs_spec.tasks import TaskSpec

Columns = dict[str, NDArray[Any]]

QUANTILES = (0.01, 0.10, 0.50, 0.90, 0.99)
# Beginning of the names of observed parts that do not belong to the robot.
_OBJECT = 'object'
# Numbers of frames, episodes and tasks.
_COUNTS = ('frame_index', 'episode_index', 'index', 'task_index')


def features(spec: TaskSpec) -> dict[str, dict[str, Any]]:
    """Return type, shape and names of the columns, as in `meta/info.json`."""
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
    """Return the names of the observed numbers of the robot, and of its object."""
    robot: list[str] = []
    rest: list[str] = []
    for part in spec.observation:
        into = rest if part.name.startswith(_OBJECT) else robot
        into += [f'{part.name}_{index}' for index in range(part.size)]
    return robot, rest


def frames(episode: EpisodeArrays, episode_index: int, first_index: int) -> Columns:
    """Return the columns of the N frames of an episode, one per action.

    Args:
        episode_index: Number of the episode in the dataset.
        first_index: Number of frames before it.
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
    """Return the statistics of frames (n,) or (n, size) for normalisation; each is a list."""
    rows = values.reshape(len(values), -1)
    numbers = rows.astype(np.float64)
    return {
        'min': rows.min(axis=0).tolist(),
        'max': rows.max(axis=0).tolist(),
        'mean': numbers.mean(axis=0).tolist(),
        'std': numbers.std(axis=0).tolist(),
        'count': [len(rows)],
        **{
            quantile_name(share): quantile.tolist()
            for share, quantile in zip(
                QUANTILES, np.quantile(numbers, QUANTILES, axis=0), strict=True
            )
        },
    }


def quantile_name(share: float) -> str:
    """Return the name of a quantile, such as `q50`."""
    return f'q{round(100 * share):02d}'
