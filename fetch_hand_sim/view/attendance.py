"""Whether somebody is at the page, so that a robot does not go on with what was held there."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

# Seconds without input that say that nobody is there. A page that is shown sends at every frame of
# its browser, whatever the mouse does; one that is hidden, asleep or cut off sends nothing.
_SILENCE = 3.0


class Attendance:
    """Notes when the page in control was heard; any thread may do so.

    Args:
        clock: A steady clock, seconds.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._heard = -math.inf

    def note(self) -> None:
        """Takes that the page in control has sent something."""
        self._heard = self._clock()

    @property
    def is_there(self) -> bool:
        """Whether somebody sees the page and can let go of what is held."""
        return self._clock() - self._heard < _SILENCE
