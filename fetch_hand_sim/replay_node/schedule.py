"""Messages of a recorded episode and the times to publish them, without ROS."""

from __future__ import annotations

import math
import re
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from fetch_hand_sim.episode_log import read_episode
from fetch_hand_sim.episode_log.metadata import parse_control_hz
from fetch_hand_sim.episode_log.reader import logged_topics, one_line_errors
from msgs_spec.schemas import deserialize
from msgs_spec.topics import TopicSpec, relative_name

# Resolved names that ROS accepts; `rmw` limits the length.
_TOPIC_NAME = re.compile(r'(/[A-Za-z_][A-Za-z0-9_]*)+')
_LONGEST_NAME = 247
_SHOWN = 80


@dataclass(frozen=True, slots=True)
class ReplayMessage:
    """A message to publish at log time `time_ns` on the topic `name`."""

    time_ns: int
    name: str
    data: bytes


class ReplaySchedule:
    """The messages of an episode to publish; `messages` is sorted by log time.

    Args:
        topics: Topics to publish; empty for all topics that the robot published.
        with_inputs: Whether to publish also the commands and goals that the robot received, if
            `topics` is empty.

    Attributes:
        start_ns: Log time of the first message of the episode, published or not.
        end_ns: Log time of the last message of the episode.
        period_ns: Nanoseconds of simulated time per tick.
        namespace: ROS namespace of the recorded robot; '' for the root.
    """

    def __init__(self, path: Path, topics: Iterable[str] = (), with_inputs: bool = False) -> None:
        episode = read_episode(path)
        specs = logged_topics(episode)
        with one_line_errors(episode.path):
            self.period_ns = round(1e9 / parse_control_hz(episode.metadata))
            _require_names(specs)
        wanted = _wanted(specs, list(topics), with_inputs)
        self.topics = {name: spec for name, spec in specs.items() if name in wanted}
        self.messages = [
            ReplayMessage(log_time, name, data)
            for id, _, log_time, _, data in episode.sorted_messages.rows()
            if (name := episode.channels[id].topic) in wanted
        ]
        with one_line_errors(episode.path):
            for message in self.messages:
                deserialize(self.topics[message.name].type_name, message.data)
        times = episode.sorted_messages.headers['log_time']
        self.start_ns, self.end_ns = int(times[0]), int(times[-1])
        status = next((n for n in episode.topics if n.endswith('/episode_status')), '/')
        self.namespace = status.rpartition('/')[0]

    def index_at(self, time_ns: int) -> int:
        """Return the index of the first message at or after a log time; `len(messages)` if none."""
        return bisect_left(self.messages, time_ns, key=lambda message: message.time_ns)

    def latched_at(self, time_ns: int) -> list[ReplayMessage]:
        """Return one message of each latched topic: the last before `time_ns`, or else the first.

        Published at the start, they describe the robot to subscribers.
        """
        found: dict[str, ReplayMessage] = {}
        for message in self.messages:
            is_latched = self.topics[message.name].qos.durability == 'transient_local'
            if is_latched and (message.time_ns < time_ns or message.name not in found):
                found[message.name] = message
        return list(found.values())


def _wanted(specs: dict[str, TopicSpec], names: list[str], with_inputs: bool) -> set[str]:
    short = {relative_name(name): name for name in specs}
    unknown = [name for name in names if name not in specs and name not in short]
    if unknown:
        raise ValueError(f'no topic {unknown[0]!r} in the episode; allowed: {", ".join(specs)}')
    if names:
        return {name if name in specs else short[name] for name in names}
    return {name for name, s in specs.items() if with_inputs or s.direction == 'published'}


def _require_names(names: Iterable[str]) -> None:
    for name in names:
        if len(name) > _LONGEST_NAME or not _TOPIC_NAME.fullmatch(name):
            raise ValueError(
                f'topic {name[:_SHOWN]!r}; allowed: names of ROS, up to {_LONGEST_NAME} characters'
            )


class Playhead:
    """Computes the position of a replay, a log time, which grows with wall-clock time.

    It is `position_ns` at the first `now`; each `now` is a time, s, of one steady clock. `rate` is
    simulated seconds per second; 0 pauses.
    """

    def __init__(self, position_ns: int, rate: float, now: float) -> None:
        self._position_ns = position_ns
        self._since = now
        self.rate = rate

    def position_ns(self, now: float) -> int:
        """Return the log time up to which messages are due."""
        return self._position_ns + int((now - self._since) * self.rate * 1e9)

    def remaining(self, time_ns: int, now: float) -> float:
        """Return the wall-clock seconds until a log time is reached; infinity while paused."""
        if not self.rate:
            return math.inf
        return (time_ns - self._position_ns) / 1e9 / self.rate - (now - self._since)

    def set_rate(self, rate: float, now: float) -> None:
        """Change the rate at time `now`; the position does not jump."""
        self.jump(self.position_ns(now), now)
        self.rate = rate

    def jump(self, position_ns: int, now: float) -> None:
        """Set the position at time `now`."""
        self._position_ns, self._since = position_ns, now
