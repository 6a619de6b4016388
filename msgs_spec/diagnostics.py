"""What nodes say about themselves on `/diagnostics`, and the statistics behind it.

Wall-clock content: it is never logged with an episode, whose bytes depend on seed and commands
only.
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
# Keys of what a robot reports that pages, policies and benchmarks read.
MODE = 'mode'
PAUSED = 'paused'
RATE = 'rate (Hz)'
ASKED_RATE = 'rate asked (Hz)'
MISSED_TICKS = 'missed ticks'
PERTURB_LIMIT = 'perturb limit (N)'
COMMANDERS = 'commanders'
# What a stamp can say, whose seconds are an int32: a machine may believe that it is 2038.
_LATEST = (2**31 - 1) * 10**9


def next_report(due: float, now: float) -> float:
    """When the report after one that was due, and is made now, is due: seconds of a steady clock.

    Periods keep their beat unless one was missed: then the next one is whole, too.
    """
    return due + REPORT_PERIOD if due + REPORT_PERIOD > now else now + REPORT_PERIOD


class Level(IntEnum):
    """The levels of `diagnostic_msgs/DiagnosticStatus`."""

    OK = 0
    WARN = 1
    ERROR = 2


@dataclass(slots=True)
class Report:
    """One status: facts as key/value pairs, and what is wrong among them.

    Attributes:
        name: Who reports, fully qualified.
        hardware_id: What is reported on.
        values: The facts.
        summary: The message where nothing is wrong.
        problems: What is wrong, each with its level.
    """

    name: str
    hardware_id: str
    values: Mapping[str, str]
    summary: str
    problems: list[tuple[Level, str]] = field(default_factory=list)

    def warn(self, problem: str) -> None:
        """Adds what hinders but does not stop."""
        self.problems.append((Level.WARN, problem))

    def fail(self, problem: str) -> None:
        """Adds what makes the results wrong or lost."""
        self.problems.append((Level.ERROR, problem))

    @property
    def level(self) -> Level:
        """The worst of the problems."""
        return max((level for level, _ in self.problems), default=Level.OK)

    @property
    def message(self) -> str:
        """All problems, the worst first, or the summary."""
        ranked = sorted(self.problems, key=lambda problem: -problem[0])
        return '; '.join(text for _, text in ranked) or self.summary


def encode_reports(*reports: Report) -> bytes:
    """Returns the CDR bytes of a DiagnosticArray with these statuses, one or more.

    It is stamped with wall time, as REP 107 has it, whatever clock the node follows: what it says
    is of that time, and the reports of several nodes can be put in order.
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
    """The latest thousand durations of something that happens again and again."""

    def __init__(self) -> None:
        self._values: deque[float] = deque(maxlen=1000)

    def add(self, seconds: float) -> None:
        """Notes one."""
        self._values.append(seconds)

    def median(self) -> float:
        """Return the median, s; 0 before the first duration."""
        return float(np.median(self._values)) if self._values else 0.0

    def milliseconds(self) -> dict[str, str]:
        """Returns median, 99th percentile and maximum as text; `-` while there are none."""
        names = ('p50', 'p99', 'max')
        if not self._values:
            return dict.fromkeys(names, '-')
        figures = 1e3 * np.percentile(self._values, (50.0, 99.0, 100.0))
        return {name: f'{figure:.3f}' for name, figure in zip(names, figures, strict=True)}


class Increase:
    """How much a counter has grown between two looks; it starts at zero."""

    def __init__(self) -> None:
        self._before = 0.0

    def since(self, value: float) -> float:
        """Returns the growth since the last call."""
        grown, self._before = value - self._before, value
        return grown
