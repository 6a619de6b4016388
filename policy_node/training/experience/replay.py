"""Store whole episodes, as hindsight needs them, and define batches of transitions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from msgs_spec.arrays import Array, Array32

# Smallest distance of the achieved goal from its start that counts as a motion: metres, and for
# poses units of the quaternion (0.01 is a rotation by 0.02 rad).
MOVED_DISTANCE = 0.01


@dataclass(frozen=True, slots=True)
class Episodes:
    """Arrays of several episodes, all of T steps.

    Attributes:
        observation: (episodes, T + 1, observation_size).
        achieved_goal: (episodes, T + 1, goal_size).
        desired_goal: (episodes, goal_size); constant within an episode.
        action: (episodes, T, action_size).
    """

    observation: Array32
    achieved_goal: Array32
    desired_goal: Array32
    action: Array32

    def __len__(self) -> int:
        return len(self.action)

    @property
    def ticks(self) -> int:
        """Steps per episode."""
        return int(self.action.shape[1])

    def select(self, rows: NDArray[np.bool_ | np.int64] | slice) -> Episodes:
        """Return the selected episodes: copies for indices or a mask, views for a slice."""
        return Episodes(*(getattr(self, name)[rows] for name in Episodes.__slots__))


Weigh = Callable[[Episodes], NDArray[np.float64]]
"""A function that returns the weight of each episode, (episodes,)."""


def has_moved(episodes: Episodes) -> NDArray[np.float64]:
    """Return (episodes,): 1 if the achieved goal left its start by > `MOVED_DISTANCE`, else 0."""
    offset = episodes.achieved_goal - episodes.achieved_goal[:, :1]
    moved = np.square(offset).sum(axis=-1).max(axis=-1) > MOVED_DISTANCE**2
    return np.asarray(moved, dtype=np.float64)


class EpisodeReplay:
    """Ring buffer of the newest episodes, in arrays that are allocated once.

    Linux provides the memory only when episodes fill it.

    Args:
        capacity: Largest number of episodes.
        ticks: Steps per episode.
        weigh: Function that returns the weight of each episode for `draw`.
        count_ticks: Function that returns how many steps at the start of each episode are valid,
            (episodes,). Learning uses only valid steps. None makes all valid.
    """

    def __init__(
        self,
        capacity: int,
        ticks: int,
        observation_size: int,
        goal_size: int,
        action_size: int,
        weigh: Weigh = has_moved,
        count_ticks: Callable[[Episodes], NDArray[np.int64]] | None = None,
    ) -> None:
        self._ring = Episodes(
            observation=np.zeros((capacity, ticks + 1, observation_size), np.float32),
            achieved_goal=np.zeros((capacity, ticks + 1, goal_size), np.float32),
            desired_goal=np.zeros((capacity, goal_size), np.float32),
            action=np.zeros((capacity, ticks, action_size), np.float32),
        )
        self._weigh = weigh
        self._count_ticks = count_ticks
        self._weights = np.zeros(capacity)
        self._valid = np.full(capacity, ticks)
        # Cumulative sums over rows: valid ticks, and weights times valid ticks.
        self._ticks_up_to, self._weight_up_to = np.zeros(0), np.zeros(0)
        self.capacity = capacity
        self._size = 0
        self._next = 0

    def __len__(self) -> int:
        """Number of stored episodes."""
        return self._size

    @property
    def episodes(self) -> Episodes:
        """Views of the stored episodes, in no particular order."""
        return self._ring.select(slice(self._size))

    @property
    def ticks(self) -> int:
        """Steps per episode."""
        return self._ring.ticks

    def bytes_of(self, count: int) -> int:
        """Return the memory of min(count, capacity) episodes, in bytes."""
        whole = sum(getattr(self._ring, name).nbytes for name in Episodes.__slots__)
        return int(whole) * min(count, self.capacity) // self.capacity

    def newest(self, count: int) -> Episodes:
        """Return copies of the newest episodes, at most `count`; the newest is last."""
        number = min(count, self._size)
        return self._ring.select((self._next - number + np.arange(number)) % self.capacity)

    def add(self, episodes: Episodes) -> None:
        """Store episodes; a full replay overwrites its oldest ones.

        Raises:
            ValueError: If there are more than `capacity` episodes, or their sizes do not fit.
        """
        for name in Episodes.__slots__:
            given, held = getattr(episodes, name).shape[1:], getattr(self._ring, name).shape[1:]
            if given != held:
                raise ValueError(f'{name} of an episode is {given}, in the replay {held}')
        if len(episodes) > self.capacity:
            raise ValueError(f'{len(episodes)} episodes exceed the capacity of {self.capacity}')
        rows = (self._next + np.arange(len(episodes))) % self.capacity
        for name in Episodes.__slots__:
            getattr(self._ring, name)[rows] = getattr(episodes, name)
        self._weights[rows] = self._weigh(episodes)
        if self._count_ticks is not None:
            self._valid[rows] = self._count_ticks(episodes)
        self._next = int((self._next + len(episodes)) % self.capacity)
        self._size = min(self._size + len(episodes), self.capacity)
        valid = self._valid[: self._size] / self.ticks
        self._ticks_up_to = np.cumsum(valid)
        self._weight_up_to = np.cumsum(self._weights[: self._size] * valid)

    @property
    def valid_ticks(self) -> NDArray[np.int64] | None:
        """Number of valid steps at the start of each stored episode; None if all are valid."""
        return None if self._count_ticks is None else self._valid[: self._size]

    def draw(
        self, count: int, weighted_share: float, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draw episodes with replacement, in proportion to their number of valid steps.

        Args:
            count: Number of episodes to draw.
            weighted_share: Share of the draws, 0 ... 1, whose probability is also proportional to
                the weight of the episode. It has no effect if all weights are 0.

        Returns:
            Row numbers of `episodes`, (count,).
        """
        if self._count_ticks is None:
            row = generator.integers(self._size, size=count)
        else:
            row = draw_by(self._ticks_up_to, count, generator)
        chosen = np.flatnonzero(generator.random(count) < weighted_share)
        if len(chosen) and self._weight_up_to[-1] > 0.0:
            row[chosen] = draw_by(self._weight_up_to, len(chosen), generator)
        return row


def draw_by(sums: Array, count: int, generator: np.random.Generator) -> NDArray[np.int64]:
    """Draw `count` row numbers, with replacement, by weights with the cumulative sums `sums`."""
    # A draw may round up to the last sum: it means the last row with a weight above 0.
    last = np.searchsorted(sums, sums[-1])
    row = np.searchsorted(sums, sums[-1] * generator.random(count), 'right')
    return np.asarray(np.minimum(row, last))


@dataclass(frozen=True, slots=True)
class Starts:
    """The states in which the transitions of a batch begin.

    Attributes:
        episodes: The episodes from which the transitions are drawn.
        row: Row number of the episode of each transition, (batch,).
        tick: Tick of the first state of each transition, (batch,).
        valid_ticks: Number of steps at the start of each episode that are used for learning,
            (episodes,); None if all are.
    """

    episodes: Episodes
    row: NDArray[np.int64]
    tick: NDArray[np.int64]
    valid_ticks: NDArray[np.int64] | None = None

    @property
    def last(self) -> NDArray[np.int64]:
        """Tick of the state after the last valid step in each transition's episode, (batch,)."""
        if self.valid_ticks is None:
            return np.full(len(self.row), self.episodes.ticks)
        return self.valid_ticks.take(self.row)

    def select(self, chosen: NDArray[np.intp]) -> Starts:
        """Return the states of only those transitions of the batch with the indices `chosen`."""
        return Starts(self.episodes, self.row[chosen], self.tick[chosen], self.valid_ticks)


@dataclass(frozen=True, slots=True)
class Transitions:
    """A batch of transitions for one update of the networks, float32.

    Attributes:
        observation: (batch, observation_size).
        next_observation: (batch, observation_size), one step later, or n steps later for an n-step
            return.
        goal: (batch, goal_size), after relabelling.
        action: (batch, action_size).
        reward: (batch,) for `goal`; for an n-step return, the discounted sum of n rewards.
        discount: (batch,) factor of the value of `next_observation`. The target of the critic is
            the reward plus this product.
    """

    observation: Array32
    next_observation: Array32
    goal: Array32
    action: Array32
    reward: Array32
    discount: Array32
