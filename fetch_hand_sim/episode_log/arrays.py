"""Load episodes as arrays for learning."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.episode_log.files import EpisodeReadError, expand_episodes, read_each
from fetch_hand_sim.episode_log.metadata import (
    DIVERGED,
    EpisodeOutcome,
    EpisodeRecord,
    HasOutcome,
)
from fetch_hand_sim.episode_log.reader import Episode, one_line_errors, read_episode
from msgs_spec.arrays import Array, Flags
from msgs_spec.codecs import TopicCodec
from msgs_spec.observations import ObservationAssembler
from msgs_spec.robots import action_from_command
from msgs_spec.tasks import TaskSpec
from msgs_spec.topics import topic


# Compared by identity, because `==` of arrays is an array.
@dataclass(frozen=True, slots=True, eq=False)
class EpisodeArrays(HasOutcome):
    """One episode of N steps; step k leads from observation k to observation k + 1.

    Attributes:
        path: The MCAP file.
        spec: The task with its default joint names and the `episode_ticks` of the episode.
        observations: `observation`, `achieved_goal` and `desired_goal`, (N + 1, size) each, as
            `Simulation` returns them, bit for bit.
        actions: (N, action size), normalised to [-1, 1].
        commands: (N, action size), applied commands, command units.
        rewards: (N,).
        terminated: (N,) always False, because no task has a terminal state.
        truncated: (N,) True only at the last step: time was up, the simulation diverged, or the
            episode was interrupted.
        success: (N + 1,) whether the goal was reached.
        stamps: (N + 1,) simulated time, nanoseconds.
        metadata: The metadata record `episode`; `record` contains its parsed values.
        result: The metadata record `episode_result`; `outcome` contains its parsed values.
    """

    path: Path
    spec: TaskSpec
    observations: dict[str, Array]
    actions: Array
    commands: Array
    rewards: Array
    terminated: Flags
    truncated: Flags
    success: Flags
    stamps: NDArray[np.int64]
    metadata: dict[str, str]
    record: EpisodeRecord
    result: dict[str, str]

    def __len__(self) -> int:
        return len(self.rewards)

    @property
    def goals(self) -> Array:
        """Desired goals, (N + 1, goal size); they change when a user sets another goal."""
        return self.observations['desired_goal']


def load_episodes(
    path: Path | str, on_skip: Callable[[EpisodeReadError], None] | None = None
) -> list[EpisodeArrays]:
    """Load one episode, or all episodes in a directory, sorted by name; [] if it has none.

    Interrupted episodes are included up to their last whole tick; their `is_complete` is False.
    If the simulation diverged, the last step is left out, because it leads to a new episode.

    Args:
        path: A bag directory, an MCAP file, or a directory that contains several of these.
        on_skip: Called with the error of each unreadable episode, which is left out. None raises
            the first such EpisodeReadError. A missing `path` always raises it.
    """
    return list(read_each(expand_episodes(path), load_episode, on_skip))


def load_episode(path: Path) -> EpisodeArrays:
    """Load a bag directory or an MCAP file; EpisodeReadError if it is not a valid episode."""
    return arrays_of(read_episode(path))


def arrays_of(file: Episode) -> EpisodeArrays:
    """Decode the messages of an episode; EpisodeReadError if some are missing or invalid."""
    with one_line_errors(file.path):
        return _decode(file)


@lru_cache(maxsize=256)
def _codec(task: TaskSpec, name: str) -> TopicCodec:
    return TopicCodec(topic(task, name))


@lru_cache(maxsize=256)
def _assembler(task: TaskSpec, control_hz: float) -> ObservationAssembler:
    return ObservationAssembler(task, control_hz)


def _decode(file: Episode) -> EpisodeArrays:
    """Decode an episode into arrays; ValueError if messages are missing or stamps not in order."""
    record = EpisodeRecord.parse(file.metadata)
    task, assembler = record.task, _assembler(record.task, record.control_hz)
    names = [spec.name for spec in assembler.topics]
    # A cut-off episode may contain a part of its last tick.
    ticks = min(file.count(name) for name in (*names, 'is_success'))
    ticks = min(ticks, 1 + file.count('applied_command'))
    outcome = EpisodeOutcome.parse(file.result)
    if outcome.reason == DIVERGED and ticks > 1:
        ticks -= 1
    stamps, first = _codec(task, names[0]).decode_many(file.rows(names[0])[1][:ticks])
    if not (np.diff(stamps) > 0).all():
        raise ValueError('stamps do not grow')
    others = {name: stamped_vectors(file, task, name, stamps) for name in names[1:]}
    rewards = _unstamped_vectors(file, task, 'reward', stamps, first=1)[:, 0]
    commands = _unstamped_vectors(file, task, 'applied_command', stamps, first=1)
    steps = ticks - 1
    if outcome.is_complete and outcome.steps not in (None, steps):
        raise ValueError(f'it records {outcome.steps} steps and contains {steps}')
    return EpisodeArrays(
        path=file.path,
        spec=record.spec,
        observations=assembler.assemble({names[0]: first, **others}),
        actions=action_from_command(task.robot, commands),
        commands=commands,
        rewards=rewards,
        terminated=np.zeros(steps, dtype=bool),
        truncated=np.arange(steps) == steps - 1,
        success=_unstamped_vectors(file, task, 'is_success', stamps, first=0)[:, 0] != 0.0,
        stamps=stamps,
        metadata=file.metadata,
        record=record,
        result=file.result,
    )


def stamped_vectors(file: Episode, task: TaskSpec, name: str, stamps: NDArray[np.int64]) -> Array:
    """Return the vectors (N, size) of a topic; ValueError unless its stamps are `stamps` (N,)."""
    given, vectors = _codec(task, name).decode_many(file.rows(name)[1][: len(stamps)])
    if not np.array_equal(given, stamps):
        raise ValueError(f'{name} is missing at some ticks')
    return vectors


def _unstamped_vectors(
    file: Episode, task: TaskSpec, name: str, stamps: NDArray[np.int64], first: int
) -> Array:
    """Return the vectors of a topic without header stamps, from tick `first` to the last tick.

    `stamps` contains the stamps of all ticks. The log time of a message, compared with them,
    determines its tick; ValueError if a tick has no message.
    """
    count = len(stamps) - first
    if not count:
        return np.zeros((0, topic(task, name).size))
    log_times, data = file.rows(name)
    ticks = np.searchsorted(stamps, log_times[:count], side='right') - 1
    if not np.array_equal(ticks, np.arange(first, len(stamps))):
        raise ValueError(f'{name} is missing at some ticks')
    return _codec(task, name).decode_many(data[:count])[1]
