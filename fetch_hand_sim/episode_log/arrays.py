"""Load episodes as arrays for learning."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.episode_log.files import EpisodeReadError, expand_episodes
from fetch_hand_sim.episode_log.metadata import EpisodeOutcome, EpisodeRecord, HasOutcome
from fetch_hand_sim.episode_log.reader import Episode, MessageRows, read_episode
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
        spec: The task with the `episode_ticks` of the episode.
        observations: `observation`, `achieved_goal` and `desired_goal`, (N + 1, size) each, as
            `Simulation` returns them, bit for bit.
        actions: (N, action size), normalised to [-1, 1].
        commands: (N, action size), applied commands, command units.
        rewards: (N,).
        terminated: (N,): no task ends in a terminal state, so all False.
        truncated: (N,): True at the last step, where time, divergence or an interruption ended it.
        success: (N + 1,): whether the goal was reached.
        stamps: (N + 1,) simulated time, nanoseconds.
        metadata: The metadata record `episode`; `record` is the same, parsed.
        result: The metadata record `episode_result`; `outcome` is the same, parsed.
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
    """Load one episode, or all of a directory of episodes, by name.

    Interrupted episodes are included up to their last whole tick; `is_complete` marks them.

    Args:
        path: A bag directory, an MCAP file, or a directory of either.
        on_skip: Called with the error of each unreadable episode, which is left out; by default the
            EpisodeReadError is raised.
    """
    episodes = []
    for candidate in expand_episodes(Path(path)):
        try:
            episodes.append(load_episode(candidate))
        except EpisodeReadError as error:
            if on_skip is None:
                raise
            on_skip(error)
    return episodes


def load_episode(path: Path) -> EpisodeArrays:
    """Load one episode; see `load_episodes`."""
    file = read_episode(path)
    try:
        return _Decoder(file).decode()
    except EpisodeReadError:
        raise
    except (ValueError, KeyError) as error:
        raise EpisodeReadError(f'{file.path}: no readable episode: {error}') from error


@lru_cache(maxsize=256)
def _codec(task: TaskSpec, name: str) -> TopicCodec:
    return TopicCodec(topic(task, name))


@lru_cache(maxsize=256)
def _assembler(task: TaskSpec, control_hz: float) -> ObservationAssembler:
    return ObservationAssembler(task, control_hz)


class _Decoder:
    """Decodes the topics of one file and joins them by tick."""

    def __init__(self, file: Episode) -> None:
        self._file = file
        self._record = EpisodeRecord.parse(file.metadata)
        self._task = self._record.task
        self._assembler = _assembler(self._task, self._record.control_hz)

    def decode(self) -> EpisodeArrays:
        states = {spec.name: self._file.rows(spec.name) for spec in self._assembler.topics}
        success = self._file.rows('is_success')
        # A cut-off episode may contain a part of its last tick.
        ticks = min(len(rows.data) for rows in (*states.values(), success))
        ticks = min(ticks, 1 + self._file.count('applied_command'))
        stamps, vectors = self._states(states, ticks)
        rewards = self._steps('reward', stamps)[:, 0]
        commands = self._steps('applied_command', stamps)
        steps = ticks - 1
        outcome = EpisodeOutcome.parse(self._file.result)
        if outcome.is_complete and outcome.steps not in (None, steps):
            raise ValueError(f'it records {outcome.steps} steps and contains {steps}')
        return EpisodeArrays(
            path=self._file.path,
            spec=self._record.spec,
            observations=self._assembler.assemble(vectors),
            actions=action_from_command(self._task.robot, commands),
            commands=commands,
            rewards=rewards,
            terminated=np.zeros(steps, dtype=bool),
            truncated=np.arange(steps) == steps - 1,
            success=self._decoded('is_success', success, stamps, first=0)[:, 0] != 0.0,
            stamps=stamps,
            metadata=self._file.metadata,
            record=self._record,
            result=self._file.result,
        )

    def _states(
        self, rows: dict[str, MessageRows], ticks: int
    ) -> tuple[NDArray[np.int64], dict[str, Array]]:
        """Return stamps and vectors of the observed topics, which share the stamp of each tick."""
        vectors: dict[str, Array] = {}
        stamps: NDArray[np.int64] | None = None
        for name, found in rows.items():
            given, values = _codec(self._task, name).decode_many(found.data[:ticks])
            vectors[name] = values
            stamps = given if stamps is None else stamps
            if not np.array_equal(given, stamps):
                raise ValueError(f'{name} has other stamps than the topics before it')
        if stamps is None or not (np.diff(stamps) > 0).all():
            raise ValueError('stamps do not grow')
        return stamps, vectors

    def _steps(self, name: str, stamps: NDArray[np.int64]) -> Array:
        """Return the vectors of a topic that has no message at the reset, one per step."""
        if len(stamps) == 1:
            return np.zeros((0, topic(self._task, name).size))
        return self._decoded(name, self._file.rows(name), stamps, first=1)

    def _decoded(
        self, name: str, rows: MessageRows, stamps: NDArray[np.int64], first: int
    ) -> Array:
        """Return the vectors of a topic without stamps; the log times tell their ticks."""
        count = len(stamps) - first
        ticks = np.searchsorted(stamps, rows.log_times[:count], side='right') - 1
        if not np.array_equal(ticks, np.arange(first, len(stamps))):
            raise ValueError(f'{name} is missing at some ticks')
        return _codec(self._task, name).decode_many(rows.data[:count])[1]
