"""An episode tick by tick: what the robot said, then what it received before the next tick."""

from __future__ import annotations

from dataclasses import dataclass, field

from fetch_hand_sim.episode_log.episode_record import parse_task
from fetch_hand_sim.episode_log.errors import EpisodeReadError
from fetch_hand_sim.episode_log.reader import Episode
from msgs_spec.codecs import message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.tasks import TaskSpec
from msgs_spec.text import one_line
from msgs_spec.topics import TopicSpec, ground_truth_topics, relative_name, topics

_CLOCK = '/clock'


@dataclass(frozen=True, slots=True)
class TickMessage:
    """A message of a tick.

    Attributes:
        topic: What it is; its name is relative to the namespace of the robot.
        log_time_ns: When it was logged.
        data: CDR bytes.
    """

    topic: TopicSpec
    log_time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class LoggedTick:
    """The messages from one stamp to the next.

    Attributes:
        stamp_ns: Stamp of the tick.
        published: What the robot said, in order.
        received: What it received after that, in order.
    """

    stamp_ns: int
    published: list[TickMessage] = field(default_factory=list)
    received: list[TickMessage] = field(default_factory=list)

    def find(self, name: str) -> TickMessage | None:
        """Returns the published message of a topic, None if there is none."""
        return next((m for m in self.published if m.topic.name == name), None)


def episode_task(episode: Episode) -> TaskSpec:
    """Returns the task of an episode.

    Raises:
        EpisodeReadError: If it is unknown.
    """
    try:
        return parse_task(episode.metadata)
    except ValueError as error:
        raise EpisodeReadError(f'{episode.path}: {error}') from error


def logged_topics(episode: Episode) -> dict[str, TopicSpec]:
    """Returns the topics of an episode, as the task has them, by resolved name.

    Raises:
        EpisodeReadError: If the task has no such topic, or of another type.
    """
    task = episode_task(episode)
    specs = (*topics(task), *ground_truth_topics(task))
    known = {spec.name.lstrip('/'): spec for spec in specs}
    found = {}
    for name, logged in episode.topics.items():
        spec = known.get(relative_name(name))
        if spec is None or spec.type_name != logged.type_name:
            raise EpisodeReadError(
                f'{episode.path}: {task.name} has no topic {name} of type {logged.type_name}'
            )
        found[name] = spec
    return found


def split_ticks(episode: Episode) -> list[LoggedTick]:
    """Returns the ticks of an episode in order; each begins with `/clock`.

    Raises:
        EpisodeReadError: If the topics are not those of the task, or do not begin with a clock.
    """
    specs = logged_topics(episode)
    messages = sorted(
        (
            TickMessage(specs[name], message.log_time_ns, message.data)
            for name, logged in episode.topics.items()
            for message in logged.messages
        ),
        key=lambda message: message.log_time_ns,
    )
    ticks: list[LoggedTick] = []
    for message in messages:
        if message.topic.name == _CLOCK:
            ticks.append(LoggedTick(_stamp(episode, message)))
        if not ticks:
            raise EpisodeReadError(f'{episode.path}: it begins with {message.topic.name}, no clock')
        is_published = message.topic.direction == 'published'
        (ticks[-1].published if is_published else ticks[-1].received).append(message)
    return ticks


def _stamp(episode: Episode, clock: TickMessage) -> int:
    try:
        return message_stamp(deserialize(clock.topic.type_name, clock.data))
    except ValueError as error:
        raise EpisodeReadError(f'{episode.path}: unreadable clock ({one_line(error)})') from error
