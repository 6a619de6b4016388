"""Reports of the nodes on `/diagnostics`, and their statistics.

Reports depend on wall-clock time. They are never logged with an episode, because the bytes of an
episode file depend on seed and commands only.
"""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from msgs_spec.codecs import build_status
from msgs_spec.schemas import serialize
from msgs_spec.topics import DIAGNOSTICS

REPORT_PERIOD = 1.0
# Keys of the simulator node that pages, policies and benchmarks read.
MODE = 'mode'
PAUSED = 'paused'
RATE = 'rate (Hz)'
ASKED_RATE = 'rate asked (Hz)'
MISSED_TICKS = 'missed ticks'
LATE_COMMANDS = 'late commands'
PERTURB_LIMIT = 'perturb limit (N)'
COMMANDERS = 'commanders'
# The latest stamp, whose seconds are an int32. Clocks of machines may be later.
_LATEST = (2**31 - 1) * 10**9


def next_report(due: float, now: float) -> float:
    """Return the time of the next report: `REPORT_PERIOD` after `due`, that of the present report.

    Times are s of a steady clock. If that is not after `now`, return `now + REPORT_PERIOD`.
    """
    return due + REPORT_PERIOD if due + REPORT_PERIOD > now else now + REPORT_PERIOD


class Level(IntEnum):
    """The levels of `diagnostic_msgs/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(slots=True)
class Report:
    """One status of `/diagnostics`; `summary` is its message if there are no `problems`."""

    name: str
    hardware_id: str
    values: Mapping[str, str]
    summary: str
    problems: list[tuple[Level, str]] = field(default_factory=list)

    def warn(self, problem: str) -> None:
        """Add a problem of level WARN, with which the node continues to work."""
        self.problems.append((Level.WARN, problem))

    def fail(self, problem: str) -> None:
        """Add a problem of level ERROR, which makes results wrong or loses them."""
        self.problems.append((Level.ERROR, problem))

    @property
    def level(self) -> Level:
        """Level of the worst problem; OK without problems."""
        return max((level for level, _ in self.problems), default=Level.OK)

    @property
    def message(self) -> str:
        """All problems, the worst first, as one text; `summary` if there are no problems."""
        ranked = sorted(self.problems, key=lambda problem: -problem[0])
        return '; '.join(text for _, text in ranked) or self.summary


def encode_reports(*reports: Report) -> bytes:
    """Return the CDR bytes of a DiagnosticArray with one or more statuses.

    The stamp is wall-clock time, as in REP 107, so that reports of several nodes can be sorted.
    """
    stamp_ns = min(time.time_ns(), _LATEST)
    message, *others = (
        build_status(
            DIAGNOSTICS,
            stamp_ns,
            report.name,
            report.values,
            level=int(report.level),
            message=report.message,
            hardware_id=report.hardware_id,
        )
        for report in reports
    )
    message.status += [status for other in others for status in other.status]
    return serialize(DIAGNOSTICS.type_name, message)


class Durations:
    """Statistics of the last 1000 durations of a repeated event."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=1000)

    def add(self, seconds: float) -> None:
        """Add a duration, s."""
        self._values.append(seconds)

    def median(self) -> float:
        """Return the median, s; 0 before the first duration."""
        return float(np.median(self._values)) if self._values else 0.0

    def milliseconds(self) -> dict[str, str]:
        """Return `p50`, `p99` (percentiles) and `max` in ms as text; `-` without durations."""
        names = ('p50', 'p99', 'max')
        if not self._values:
            return dict.fromkeys(names, '-')
        figures = 1e3 * np.percentile(self._values, (50.0, 99.0, 100.0))
        return {name: f'{figure:.3f}' for name, figure in zip(names, figures, strict=True)}


class Increase:
    """Computes the growth of a counter that starts at zero."""

    def __init__(self) -> None:
        self._before = 0.0

    def since(self, value: float) -> float:
        """Return how much the counter has grown since the last call; `value` is its value now."""
        grown, self._before = value - self._before, value
        return grown
