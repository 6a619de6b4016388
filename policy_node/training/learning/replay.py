"""Replay of whole episodes, because hindsight needs what came later in the same one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
# An episode counts as moved when its achieved goal has left its start by this much: metres, and for
# poses units of the quaternion, whose 0.01 is a rotation by 0.02 rad.
MOVED_DISTANCE = 0.01


@dataclass(frozen=True, slots=True)
class Episodes:
    """Episodes of equal length T.

    Attributes:
        observation: (episodes, T + 1, observation_size).
        achieved_goal: (episodes, T + 1, goal_size).
        desired_goal: (episodes, goal_size); a goal lasts an episode.
        action: (episodes, T, action_size).
    """

    observation: Array
    achieved_goal: Array
    desired_goal: Array
    action: Array

    def __len__(self) -> int:
        return len(self.action)

    @property
    def ticks(self) -> int:
        """Steps per episode."""
        return int(self.action.shape[1])

    def last(self, count: int) -> Episodes:
        """Returns the last `count` episodes, or all if there are fewer."""
        return Episodes(*(getattr(self, name)[-count:] for name in Episodes.__slots__))

    def select(self, rows: NDArray[np.bool_]) -> Episodes:
        """Returns the episodes whose row is True."""
        return Episodes(
            self.observation[rows],
            self.achieved_goal[rows],
            self.desired_goal[rows],
            self.action[rows],
        )


class EpisodeReplay:
    """Ring of the latest episodes in arrays allocated once."""

    def __init__(
        self, capacity: int, ticks: int, observation_size: int, goal_size: int, action_size: int
    ) -> None:
        """Allocates room for `capacity` episodes; the memory is touched as episodes arrive."""
        if capacity < 1:
            raise ValueError(f'replay capacity {capacity} episodes; allowed: 1 or more')
        self._ring = Episodes(
            observation=np.zeros((capacity, ticks + 1, observation_size), np.float32),
            achieved_goal=np.zeros((capacity, ticks + 1, goal_size), np.float32),
            desired_goal=np.zeros((capacity, goal_size), np.float32),
            action=np.zeros((capacity, ticks, action_size), np.float32),
        )
        self._moved = np.zeros(capacity, np.bool_)
        self._moved_rows = np.zeros(0, np.int64)
        self.capacity = capacity
        self._size = 0
        self._next = 0

    def __len__(self) -> int:
        """Number of episodes held."""
        return self._size

    @property
    def episodes(self) -> Episodes:
        """Views of the episodes held, in no particular order."""
        ring, size = self._ring, self._size
        return Episodes(
            ring.observation[:size],
            ring.achieved_goal[:size],
            ring.desired_goal[:size],
            ring.action[:size],
        )

    @property
    def ticks(self) -> int:
        """Steps per episode."""
        return self._ring.ticks

    def newest(self, count: int) -> Episodes:
        """Copies of the newest episodes, the newest last; all if there are fewer than `count`."""
        ring, number = self._ring, min(count, self._size)
        rows = (self._next - number + np.arange(number)) % self.capacity
        return Episodes(*(getattr(ring, name)[rows] for name in Episodes.__slots__))

    def add(self, episodes: Episodes) -> None:
        """Adds episodes, the oldest ones making room.

        Raises:
            ValueError: If there are more than the replay holds, or of other sizes.
        """
        for name in Episodes.__slots__:
            given, held = getattr(episodes, name).shape[1:], getattr(self._ring, name).shape[1:]
            if given != held:
                raise ValueError(f'{name} of an episode is {given}, in the replay {held}')
        if len(episodes) > self.capacity:
            raise ValueError(f'{len(episodes)} episodes exceed the capacity of {self.capacity}')
        rows = (self._next + np.arange(len(episodes))) % self.capacity
        self._ring.observation[rows] = episodes.observation
        self._ring.achieved_goal[rows] = episodes.achieved_goal
        self._ring.desired_goal[rows] = episodes.desired_goal
        self._ring.action[rows] = episodes.action
        self._moved[rows] = has_moved(episodes)
        self._moved_rows = np.flatnonzero(self._moved)
        self._next = int((self._next + len(episodes)) % self.capacity)
        self._size = min(self._size + len(episodes), self.capacity)

    def draw(
        self, count: int, moved_share: float, generator: np.random.Generator
    ) -> NDArray[np.int64]:
        """Draws episodes with replacement.

        Args:
            count: How many.
            moved_share: Share drawn from the episodes whose achieved goal has moved; the others
                come from all. Where nothing has moved it has no effect.
            generator: Source of randomness.

        Returns:
            Rows of `episodes`, (count,).
        """
        row = generator.integers(self._size, size=count)
        chosen = np.flatnonzero(generator.random(count) < moved_share)
        if len(self._moved_rows):
            row[chosen] = generator.choice(self._moved_rows, size=len(chosen))
        return row


def has_moved(episodes: Episodes) -> NDArray[np.bool_]:
    """Whether the achieved goal of each episode has left its start, (episodes,)."""
    offset = episodes.achieved_goal - episodes.achieved_goal[:, :1]
    return np.asarray(np.square(offset).sum(axis=-1).max(axis=-1) > MOVED_DISTANCE**2)
