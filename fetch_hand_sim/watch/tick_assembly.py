"""Join the messages of several topics to ticks."""

from __future__ import annotations

from collections.abc import Collection

from msgs_spec.arrays import Array

# Values of the topics of one tick.
Values = dict[str, Array]
# A tick without one of these cannot be shown.
NEEDED = frozenset({'joint_states', 'desired_goal', 'achieved_goal'})
# Messages of a tick without a stamp. A reset has no reward and no command.
WITHOUT_STAMP = frozenset({'is_success', 'reward', 'applied_command'})


class TickAssembly:
    """Joins messages to ticks. Topics may deliver in any order, and messages may be lost.

    A message with a stamp belongs to the tick with that stamp, any other to the newest tick, or to
    the next one if the newest is complete. A tick ends when it or a later one is complete, or when
    two later ones have begun.

    Args:
        names: Topics of a complete tick.
    """

    def __init__(self, names: Collection[str]) -> None:
        self._names = frozenset(names)
        self._begun: dict[int, Values] = {}
        self._early: Values = {}

    def add(self, name: str, stamp_ns: int, values: Array) -> list[tuple[int, Values]]:
        """Add a message; return stamp and values of the ticks that have ended and can be shown."""
        ended: list[tuple[int, Values]] = []
        if name in WITHOUT_STAMP:
            stamp_ns = next(reversed(self._begun), stamp_ns)
        elif stamp_ns not in self._begun:
            if len(self._begun) > 1:
                ended += self._end(next(iter(self._begun)))
            self._begun[stamp_ns], self._early = self._early, {}
        tick = self._begun.get(stamp_ns, self._early)
        tick[name] = values
        return ended + (self._end(stamp_ns) if tick.keys() >= self._names else [])

    def flush(self) -> list[tuple[int, Values]]:
        """End the incomplete ticks that can be shown, and return them."""
        shown = [stamp for stamp, values in self._begun.items() if values.keys() >= NEEDED]
        return [(stamp, self._begun.pop(stamp)) for stamp in shown]

    def _end(self, newest_ns: int) -> list[tuple[int, Values]]:
        ended = []
        while newest_ns in self._begun:
            stamp_ns = next(iter(self._begun))
            values = self._begun.pop(stamp_ns)
            if values.keys() >= NEEDED:
                ended.append((stamp_ns, values))
        return ended
