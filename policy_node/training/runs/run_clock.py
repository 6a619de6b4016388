"""How long a run has taken, over all its parts."""

from __future__ import annotations

import time

from policy_node.training.runs.training_state import Counters


class RunClock:
    """Time of a run that goes on from these counters.

    Args:
        counters: What the parts before have taken.
    """

    def __init__(self, counters: Counters) -> None:
        self._started = time.monotonic() - counters.seconds
        self._processor_started = time.process_time() - counters.processor_seconds

    def write(self, counters: Counters) -> None:
        """Writes the seconds of the wall and of the processor into the counters."""
        counters.seconds = time.monotonic() - self._started
        counters.processor_seconds = time.process_time() - self._processor_started
