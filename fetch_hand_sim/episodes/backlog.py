"""A queue from a robot to the thread that writes its log, bounded by time instead of number."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from threading import Condition
from typing import Generic, TypeVar

T = TypeVar('T')


class StalledError(RuntimeError):
    """The writer did not take anything for a long time; the message is part of a line."""


class Backlog(Generic[T]):
    """Entries of one producer for one consumer, who takes them and says when they are saved.

    The producer waits while the oldest entry that is not saved is older than a limit: what a kill
    can lose is bounded, one entry more than that, and so is memory.

    Args:
        longest: Seconds an entry may go unsaved before the producer waits.
        stall: Seconds without any progress after which the producer gives up.
        clock: A steady clock, seconds.
    """

    def __init__(
        self,
        longest: float = 0.2,
        stall: float = 5.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._longest = longest
        self._stall = stall
        self._clock = clock
        self._entries: deque[tuple[float, T]] = deque()
        self._changed = Condition()
        self._unsaved_since: float | None = None
        self._is_closed = False

    def put(self, entry: T) -> float:
        """Adds an entry; returns the seconds it had to wait before.

        Raises:
            StalledError: If the consumer does not go on.
        """
        with self._changed:
            began = now = self._clock()
            while self._is_late(now):
                if not self._changed.wait(self._stall):
                    raise StalledError(f'the disk took nothing for {self._stall:g} s')
                now = self._clock()
            self._entries.append((now, entry))
            self._changed.notify()
        return now - began

    def take(self, idle: float) -> T | None:
        """Waits for an entry and returns it.

        Args:
            idle: Seconds after which None comes if nothing else did and there is something to save.

        Returns:
            The entry; None also when the producer has closed and all entries are taken.
        """
        with self._changed:
            while not self._entries:
                if self._is_closed:
                    return None
                left = None
                if self._unsaved_since is not None:
                    left = self._unsaved_since + idle - self._clock()
                    if left <= 0.0:
                        return None
                self._changed.wait(left)
            since, entry = self._entries.popleft()
            if self._unsaved_since is None:
                self._unsaved_since = since
            self._changed.notify()
            return entry

    def note_saved(self) -> None:
        """Says that all entries taken so far are saved."""
        with self._changed:
            self._unsaved_since = None
            self._changed.notify()

    def clear(self) -> None:
        """Forgets all entries."""
        with self._changed:
            self._entries.clear()
            self._unsaved_since = None
            self._changed.notify()

    def close(self) -> None:
        """Says that no more entries will come."""
        with self._changed:
            self._is_closed = True
            self._changed.notify()

    @property
    def is_done(self) -> bool:
        """Whether it is closed and all entries are taken."""
        return self._is_closed and not self._entries

    def _is_late(self, now: float) -> bool:
        oldest = self._unsaved_since
        if oldest is None:
            oldest = self._entries[0][0] if self._entries else now
        return now - oldest > self._longest
