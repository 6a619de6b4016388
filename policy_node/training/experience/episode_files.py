"""Save and load the newest episodes of a replay; convert logged episodes to training data."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load_file

from fetch_hand_sim.episode_log import EpisodeArrays, load_episodes
from fetch_hand_sim.episode_log.files import holds_no_episode
from msgs_spec.tasks import DEFAULT_CONTROL_HZ, TaskSpec
from policy_node.policies.files import write_tensors
from policy_node.training.experience.replay import EpisodeReplay, Episodes


def save_replay(path: Path, replay: EpisodeReplay, transitions: int) -> None:
    """Write the newest episodes of a replay to a file, at least `transitions` transitions.

    Only whole episodes are written. A replay with fewer transitions is written completely.

    Raises:
        OSError: If the file cannot be written; no partial file is left.
    """
    newest = replay.newest(-(-transitions // replay.ticks))
    write_tensors(path, {name: getattr(newest, name) for name in Episodes.__slots__}, {})


def load_replay(path: Path, replay: EpisodeReplay) -> None:
    """Add episodes from a file of `save_replay` to a replay; if not all fit, add the newest.

    Raises:
        ValueError: If the file cannot be read, is damaged, or its arrays do not fit the replay.
    """
    try:
        tensors = load_file(path)
        episodes = Episodes(**{name: tensors[name] for name in Episodes.__slots__})
        _require_whole(episodes)
        replay.add(episodes.select(slice(-replay.capacity, None)))
    except (OSError, SafetensorError, KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f'{path} is no replay of this run: {error}') from None


def _require_whole(episodes: Episodes) -> None:
    """Raise ValueError unless the arrays are finite float32 and have equally many episodes."""
    for name in Episodes.__slots__:
        array = getattr(episodes, name)
        if array.dtype != np.float32:
            raise ValueError(f'{name} is {array.dtype}, not float32')
        if array.shape[:1] != episodes.action.shape[:1]:
            raise ValueError(f'{name} is {array.shape}, action {episodes.action.shape}')
        if not np.isfinite(array).all():
            raise ValueError(f'{name} has a value that is not finite')


def read_experience(
    directory: Path, task: TaskSpec, control_hz: float = DEFAULT_CONTROL_HZ
) -> tuple[Episodes, list[str]]:
    """Load the logged episodes of a task that the trainer can learn from.

    Args:
        directory: Episodes of `sim_node` or `fetch_hand_sim episodes generate`.
        control_hz: Action frequency, Hz.

    Returns:
        The usable episodes, and one line for each skipped episode. An episode is skipped if it is
        damaged, interrupted, of another task or frequency, or if its goal changed.

    Raises:
        ValueError: If the directory has no usable episode.
    """
    skipped: list[str] = []
    loaded = load_episodes(directory, on_skip=lambda error: skipped.append(str(error)))
    usable = []
    for episode in loaded:
        reason = why_unusable(episode, task, control_hz)
        if reason:
            skipped.append(f'{episode.path}: {reason}')
        else:
            usable.append(episode)
    if not (usable or skipped):
        raise ValueError(str(holds_no_episode(Path(directory))))
    if not usable:
        raise ValueError(f'{directory} holds no usable episode of {task.name}, first: {skipped[0]}')
    return to_experience(usable), skipped


def why_unusable(episode: EpisodeArrays, task: TaskSpec, control_hz: float) -> str:
    """Return the reason why the trainer cannot learn from an episode, or '' if it can."""
    if episode.spec.name != task.name:
        return f'{episode.spec.name}, not {task.name}'
    if episode.record.control_hz != control_hz:
        return f'{episode.record.control_hz} Hz, not {control_hz:g} Hz'
    if not episode.is_complete or len(episode) != task.episode_ticks:
        return f'{len(episode)} of {task.episode_ticks} steps'
    if (episode.goals != episode.goals[0]).any():
        return 'its goal changed on the way'
    return ''


def to_experience(episodes: Sequence[EpisodeArrays]) -> Episodes:
    """Convert logged episodes of one task and equal length to the float32 arrays of the trainer."""

    def stack(arrays: list[np.ndarray]) -> np.ndarray:
        return np.stack(arrays).astype(np.float32)

    return Episodes(
        observation=stack([episode.observations['observation'] for episode in episodes]),
        achieved_goal=stack([episode.observations['achieved_goal'] for episode in episodes]),
        desired_goal=stack([episode.goals[0] for episode in episodes]),
        action=stack([episode.actions for episode in episodes]),
    )
