"""Joins topics by stamp: what was true at one moment, whatever order messages arrive in."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Vectors = dict[str, NDArray[np.float64]]

# Nanoseconds: a stamp further back is no late message but a simulation started anew.
_LONGEST_DELAY = 1_000_000_000


class StampJoin:
    """Collects the vectors of several topics until one stamp has them all.

    Stamps that are incomplete when a later one completes are dropped, and so is everything that
    arrives for a stamp no later than the last complete one: an actor wants the newest state, not
    every state. A stamp of long before is a simulation started anew as soon as it is complete; a
    stranger's message on one of the topics, with a stamp from anywhere, is never.

    Args:
        topics: Names of the topics to join.
        max_pending: Incomplete stamps kept; the one that came first goes first.

    Attributes:
        dropped: Incomplete stamps that were given up.
    """

    def __init__(self, topics: Iterable[str], max_pending: int = 8) -> None:
        self._topics = frozenset(topics)
        self._max_pending = max_pending
        self._pending: dict[int, Vectors] = {}
        self._last: int | None = None
        self.dropped = 0

    def add(self, topic: str, stamp: int, vector: NDArray[np.float64]) -> Vectors | None:
        """Adds one vector.

        Args:
            topic: Its topic.
            stamp: Nanoseconds.
            vector: The vector.

        Returns:
            The vectors of all topics if they are complete for this stamp, else None.
        """
        if self._last is not None and 0 <= self._last - stamp <= _LONGEST_DELAY:
            return None
        vectors = self._pending.setdefault(stamp, {})
        vectors[topic] = vector
        if vectors.keys() == self._topics:
            self._complete(stamp)
            return vectors
        while len(self._pending) > self._max_pending:
            del self._pending[next(iter(self._pending))]
            self.dropped += 1
        return None

    def forget(self) -> None:
        """Begins again: whatever stamp comes next is the first."""
        self._last = None
        self._pending.clear()

    def _complete(self, stamp: int) -> None:
        self._last = stamp
        del self._pending[stamp]
        # Late by now, or of the time before a new beginning.
        lost = [other for other in self._pending if not stamp < other <= stamp + _LONGEST_DELAY]
        self.dropped += len(lost)
        for other in lost:
            del self._pending[other]
