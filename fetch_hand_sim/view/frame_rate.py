"""How often the page of a robot is built: as often as there is news, or a hand on the mouse."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from msgs_spec.topics import LATEST_TICKS_PER_SECOND

# Seconds between two frames that only follow the robot, and so between two pictures of it.
FOLLOWING = 1.0 / LATEST_TICKS_PER_SECOND
# The same of a robot that is far faster than real time, whose ticks no eye follows one by one.
OVERLOOKING = 1.0 / 12.0
# Seconds after the last touch for which frames come as fast as the viewer makes them.
_ATTENTION = 0.5


@dataclass(frozen=True, slots=True)
class Touch:
    """What mouse and keyboard do; a page is touched where this changes or a button is held.

    Attributes:
        mouse: Where the pointer is, pixels.
        wheel: What the wheel turned in this frame.
        is_down: Whether a button is held.
        is_typing: Whether a field takes what is typed.
    """

    mouse: tuple[float, float] = (0.0, 0.0)
    wheel: float = 0.0
    is_down: bool = False
    is_typing: bool = False


class FrameRate:
    """Says how long to wait before the next frame. Times are seconds of one clock that only grows.

    A robot in lockstep beside a viewer, on two processors, pays for every frame.

    Args:
        period: Seconds between two frames while nobody touches the page, asked for each.

    Attributes:
        period: As given.
    """

    def __init__(self, period: Callable[[], float] = lambda: FOLLOWING) -> None:
        self.period = period
        self._touch = Touch()
        self._touched = 0.0
        self._began = 0.0

    def wait_time(self, now: float, touch: Touch) -> float:
        """Returns for how long to wait, and takes that the next frame begins then."""
        is_held = touch.is_down or touch.is_typing or touch.wheel != 0.0
        if is_held or touch.mouse != self._touch.mouse:
            self._touched = now
        self._touch = touch
        wait = 0.0
        if now - self._touched > _ATTENTION:
            wait = max(0.0, self._began + self.period() - now)
        self._began = now + wait
        return wait
