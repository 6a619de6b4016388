"""Join the messages of several topics by stamp, in any order of arrival."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

Vectors = dict[str, NDArray[np.float64]]

# Nanoseconds. A stamp further back means that the simulation was started again.
_LONGEST_DELAY = 1_000_000_000
# Seconds after which a message is never late.
_LATEST = 1.0


class StampJoin:
    """Collect the vectors of several topics until one stamp has all of them.

    A complete stamp drops all earlier stamps, because a policy needs the newest state only. A much
    earlier stamp that becomes complete means that the simulation was started again. A single
    message with an odd stamp from another publisher has no effect.

    Args:
        topics: Names of the topics to join.
        max_pending: Number of incomplete stamps kept; the oldest is dropped first.
        clock: A steady clock, seconds.

    Attributes:
        dropped: Number of incomplete stamps that were dropped.
    """

    def __init__(
        self,
        topics: Iterable[str],
        max_pending: int = 8,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._topics = frozenset(topics)
        self._max_pending = max_pending
        self._pending: dict[int, Vectors] = {}
        self._last: int | None = None
        self._clock = clock
        self._completed_at = -math.inf
        self.dropped = 0

    def add(self, topic: str, stamp: int, vector: NDArray[np.float64]) -> Vectors | None:
        """Add the vector of a topic; return the vectors of all topics once the stamp is complete.

        The stamp is in nanoseconds.
        """
        if self._last is not None and self._is_late(self._last - stamp):
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
        """Forget all stamps; the next one is the first."""
        self._last = None
        self._pending.clear()

    def _is_late(self, delay: int) -> bool:
        """Return whether a stamp this much before the last one belongs to the same simulation."""
        if not 0 < delay <= _LONGEST_DELAY:
            return delay == 0
        return self._clock() - self._completed_at < _LATEST

    def _complete(self, stamp: int) -> None:
        self._last, self._completed_at = stamp, self._clock()
        del self._pending[stamp]
        # Late, or from before a restart of the simulation.
        lost = [other for other in self._pending if not stamp < other <= stamp + _LONGEST_DELAY]
        self.dropped += len(lost)
        for other in lost:
            del self._pending[other]
