"""Read episode files as frames that can be drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fetch_hand_sim.episode_log import EpisodeReadError
from fetch_hand_sim.episode_log.arrays import EpisodeArrays, load_episode
from fetch_hand_sim.episode_log.files import expand_episodes, holds_no_episode
from fetch_hand_sim.episode_log.reader import Episode, read_episode
from fetch_hand_sim.simulation.rewards import GoalMetric
from fetch_hand_sim.simulation.scene import Frame
from msgs_spec.arrays import Array
from msgs_spec.codecs import TopicCodec
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topic


@dataclass(frozen=True, slots=True)
class Recording:
    """One episode of N steps, ready to be drawn.

    Attributes:
        arrays: The episode as arrays.
        frames: N + 1 frames.
        times: (N + 1,) seconds since the first frame.
        title: Name of the file.
    """

    arrays: EpisodeArrays
    frames: list[Frame]
    times: Array
    title: str

    @property
    def spec(self) -> TaskSpec:
        """The task of the episode."""
        return self.arrays.spec

    @property
    def metric(self) -> GoalMetric:
        """The metric with the success rule of the episode."""
        return GoalMetric(self.spec, success_rule=self.arrays.record.success_rule)


def load_recording(path: Path) -> Recording:
    """Read an episode.

    Raises:
        EpisodeReadError: If the episode cannot be read; the message is one line.
    """
    return recording_of(load_episode(path))


def recording_of(arrays: EpisodeArrays) -> Recording:
    """Add the joint positions and object poses of the file to an episode.

    Raises:
        EpisodeReadError: If a topic cannot be read; the message is one line.
    """
    ticks = len(arrays) + 1
    task = arrays.record.task
    messages = read_episode(arrays.path)
    joints = _vectors(messages, arrays, 'joint_states')[:, : len(task.robot.joints)]
    poses = _vectors(messages, arrays, 'object_pose') if arrays.spec.has_object else None
    achieved, desired = arrays.observations['achieved_goal'], arrays.goals
    frames = [
        Frame(
            joint_position=joints[tick],
            desired_goal=desired[tick],
            achieved_goal=achieved[tick],
            object_pose=None if poses is None else poses[tick],
            is_success=bool(arrays.success[tick]),
        )
        for tick in range(ticks)
    ]
    times = (arrays.stamps - arrays.stamps[0]) * 1e-9
    return Recording(arrays, frames, times, arrays.path.stem.removesuffix('_0'))


def _vectors(messages: Episode, arrays: EpisodeArrays, name: str) -> Array:
    """Return the vectors (N + 1, size) of a topic that has one message per tick."""
    # An interrupted episode may contain a part of one more tick.
    stamps = arrays.stamps
    try:
        rows = messages.rows(name).data[: len(stamps)]
        given, vectors = TopicCodec(topic(arrays.record.task, name)).decode_many(rows)
    except (ValueError, KeyError) as error:
        raise EpisodeReadError(f'{messages.path}: no readable {name}: {error}') from error
    if not np.array_equal(given, stamps):
        raise EpisodeReadError(f'{messages.path}: {name} is missing at some ticks')
    return vectors


def load_recordings(
    path: Path, count: int, on_skip: Callable[[EpisodeReadError], None] | None = None
) -> list[Recording]:
    """Read the first `count` episodes of a file or folder.

    Args:
        path: An episode, or a folder of episodes.
        count: Maximum number of episodes.
        on_skip: Called with the error of each unreadable episode, which is left out; None raises
            that error.

    Raises:
        EpisodeReadError: If no episode is readable, or with `on_skip=None` one is not.
    """
    recordings: list[Recording] = []
    skipped: list[EpisodeReadError] = []
    for each in find_playable(path):
        if len(recordings) == count:
            break
        try:
            recordings.append(load_recording(each))
        except EpisodeReadError as error:
            if on_skip is None:
                raise
            skipped.append(error)
    if not recordings:
        raise none_readable(skipped)
    if on_skip is not None:
        for reason in skipped:
            on_skip(reason)
    return recordings


def none_readable(errors: Sequence[EpisodeReadError]) -> EpisodeReadError:
    """Return one error for the errors of several episodes, at least one."""
    first, *others = errors
    if not others:
        return first
    return EpisodeReadError(f'none of {len(errors)} episodes can be read; the first: {first}')


def find_playable(path: Path) -> list[Path]:
    """Return the episodes of a path, sorted by name, without reading them.

    Raises:
        EpisodeReadError: If the path holds no episode.
    """
    paths = expand_episodes(path)
    if not paths:
        raise holds_no_episode(path)
    return paths
