"""The health report of `policy_node`, once a second."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from msgs_spec.tick import EpisodeStatus
from node_runtime.diagnostics import ASKED_RATE, MODE, PAUSED, RATE, Increase, Report
from node_runtime.ros import MEMORY_OF_THE_GRAPH
from policy_node.node.responder import Responder

# Seconds without a complete observation until the report warns. A paused robot publishes its
# state once a second; the slowest motion is this many times slower than real time.
_SILENCE = 2.0
_SLOWEST = 100.0
# A robot that restarts turns back once; so does a replay that is repeated.
_TURNS_OF_ONE = 1
_COUNTERS = ('answered', 'failed', 'turned_back', 'unusable')


@dataclass(frozen=True, slots=True)
class Pace:
    """The pace of a robot, from its diagnostics.

    Attributes:
        is_paused: Whether the robot is paused.
        period: Wall-clock seconds from one step to the next; infinite in lockstep, 0 at full speed.
    """

    is_paused: bool
    period: float


def read_pace(message: Any, namespace: str) -> Pace | None:
    """Return the pace of the robot in `namespace` from `/diagnostics`; None if it is missing."""
    for status in message.status:
        if status.name.rpartition('/')[0] == namespace.rstrip('/'):
            values = {pair.key: pair.value for pair in status.values}
            if PAUSED in values:
                return Pace(values[PAUSED] == 'True', _period(values))
    return None


def _period(values: Mapping[str, str]) -> float:
    if values.get(MODE) == 'lockstep':
        return math.inf
    try:
        return 1.0 / float(values.get(ASKED_RATE, ''))
    except (ValueError, ZeroDivisionError):
        return 0.0


class Health:
    """Makes diagnostic reports of the policy node `name`: commands, failures, robots and topics."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._responder: Responder | None = None
        self._tick_duration = 0.0
        self._increases: defaultdict[str, Increase] = defaultdict(Increase)
        self._then = 0.0
        # Last time without a second robot and without a second publisher of a topic.
        self._alone_at = -math.inf
        self._said: set[str] = set()

    def start(self, responder: Responder, status: EpisodeStatus, now: float) -> None:
        """Begin to report on `responder` and the robot of `status`; `now` is as in `report`."""
        self._responder, self._then = responder, now
        self._tick_duration = 1.0 / status.control_hz
        self._increases.clear()

    def stop(self) -> None:
        """Stop reporting on the robot; the next reports say that the node waits for a robot."""
        self._responder = None

    def report(
        self,
        now: float,
        robots: int,
        pace: Pace | None = None,
        elsewhere: Sequence[str] = (),
        missing: Sequence[str] = (),
        publishers: Mapping[str, int] = MappingProxyType({}),
    ) -> Report:
        """Return the report on the period since the last report.

        Args:
            now: Seconds of the responder's clock.
            robots: Number of publishers of `episode_status`.
            pace: Pace of the robot; None means real time.
            elsewhere: Namespaces of other robots; reported if this namespace has none.
            missing: Required topics without a publisher.
            publishers: Number of publishers of each state topic, by name.
        """
        turns_back = 0
        if self._responder is None:
            report = Report(self._name, '', {'robots': str(robots)}, 'waits for a robot')
        else:
            new = self._grown(self._responder)
            turns_back = new['turned_back'] // len(self._responder.topics)
            report = self._report(self._responder, new, now, robots, pace)
        if robots == 0 and elsewhere:
            report.warn(
                f'no robot here: found in {", ".join(elsewhere)}; join it with '
                f'--ros-args -r __ns:={elsewhere[0]}'
            )
        if robots and missing:
            report.warn(f'no state: no publisher of {", ".join(missing)}')
        shared = [
            f'{count} publishers of {name}' for name, count in publishers.items() if count > 1
        ]
        if robots <= 1 and not shared:
            self._alone_at = now
        # The graph still lists a robot that was killed, but only its successor publishes.
        elif turns_back > _TURNS_OF_ONE or now - self._alone_at > MEMORY_OF_THE_GRAPH:
            if robots > 1:
                report.warn(f'{robots} robots publish here; give each a namespace')
            else:
                report.warn(f'several sources of state: {", ".join(shared)}')
        return report

    def _grown(self, responder: Responder) -> dict[str, int]:
        """Return how much each counter of a responder has grown since the last report, by name."""
        counters = {name: getattr(responder, name) for name in _COUNTERS}
        counters['dropped'] = responder.join.dropped
        return {name: round(self._increases[name].since(n)) for name, n in counters.items()}

    def news(self, report: Report) -> list[str]:
        """Return the problem texts of `report` that are not in the report of the previous call.

        Problems with equal text before the first colon count as the same.
        """
        kinds = {text.partition(':')[0]: text for _, text in report.problems}
        fresh = [text for kind, text in kinds.items() if kind not in self._said]
        self._said = set(kinds)
        return fresh

    def _report(
        self,
        responder: Responder,
        new: Mapping[str, int],
        now: float,
        robots: int,
        robot_pace: Pace | None,
    ) -> Report:
        given = robot_pace or Pace(is_paused=False, period=self._tick_duration)
        seconds, self._then = now - self._then, now
        rate = new['answered'] / seconds if seconds else 0.0
        age = None if responder.received_at is None else now - responder.received_at
        inference = responder.inference.milliseconds()
        values = {
            'robots': str(robots),
            'commander': responder.policy.description,
            'checkpoint sha256': responder.policy.sha256,
            'commands': str(responder.answered),
            RATE: f'{rate:.2f}',
            **{f'inference {name} (ms)': value for name, value in inference.items()},
            'incomplete ticks dropped': str(responder.join.dropped),
            'unusable messages': str(responder.unusable),
            'failures of the policy': str(responder.failed),
            'observation age (s)': '-' if age is None else f'{age:.3f}',
        }
        task = responder.policy.task
        pace = 'the robot is paused' if given.is_paused else f'{rate:.1f} commands per second'
        report = Report(self._name, task, values, f'{task}: {pace}')
        if new['dropped']:
            report.warn(f'incomplete ticks: {new["dropped"]} dropped')
        if new['failed']:
            report.fail(f'no command: {new["failed"]} times, {responder.last_failure}')
        if new['unusable']:
            report.warn(f'unusable messages: {new["unusable"]}')
        if inference['p50'] != '-' and float(inference['p50']) > 1e3 * given.period > 0.0:
            report.warn(
                f'slow inference: {inference["p50"]} ms, a tick is {1e3 * given.period:.1f} ms; '
                'commands come late'
            )
        longest = max(_SILENCE, 2.0 * min(responder.interval, _SLOWEST * self._tick_duration))
        if robots == 0:
            report.warn('no robot publishes episode_status')
        elif age is not None and age > longest and not given.is_paused:
            report.warn(f'no state: the last one is {age:.0f} s old')
        return report
