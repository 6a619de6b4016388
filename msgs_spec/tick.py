"""The state of a robot at one tick, and the messages that report it."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, dataclass, fields
from io import BytesIO
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from msgs_spec.arrays import Array
from msgs_spec.codecs import TopicCodec, build_status
from msgs_spec.observations import Readings
from msgs_spec.robots import JOINT_PREFIX, check_joint_prefix
from msgs_spec.schemas import deserialize, message_class, serialize
from msgs_spec.tasks import (
    REWARD_TYPES,
    SUCCESS_RULES,
    RewardType,
    SuccessRule,
    TaskSpec,
    substeps_per_tick,
)
from msgs_spec.text import one_of
from msgs_spec.topics import GROUND_TRUTH, LATEST_TICK, TopicSpec, ground_truth_topics, topics

Phase = Literal['waiting', 'reset', 'running', 'finished']
# The tick of each phase. An episode that a reset ends has no `finished`.
PHASES: dict[Phase, str] = {
    'waiting': 'before the first episode',
    'reset': 'at tick 0 of an episode',
    'running': 'at the ticks between, in `latest_tick` alone',
    'finished': 'at the last tick of an episode that no reset ended',
}

_CHOICES: dict[str, tuple[str, ...]] = {
    'phase': tuple(PHASES),
    'reward_type': REWARD_TYPES,
    'success_rule': SUCCESS_RULES,
}
# As Python, C++ and YAML write them.
_FLAGS = {'True': True, 'true': True, '1': True, 'False': False, 'false': False, '0': False}
# Functions that read a value, by the type of its field.
_READERS: dict[str, Callable[[str], Any]] = {
    'str': str,
    'int': int,
    'float': float,
    'bool': _FLAGS.__getitem__,
}


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeStatus:
    """Contents of the topic `episode_status`; the message leaves out fields with default values.

    Attributes:
        episode: Index of the episode since the node started, from 0.
        tick: Steps of the episode so far; 0 is the state after the reset.
        phase: See `PHASES`.
        control_hz: Ticks per second of simulated time; observations depend on it.
        episode_return: Sum of rewards so far.
        joint_prefix: Prefix of the joint names.
        disturbances: Disturbances as JSON; empty if there are none.
        variation: Values that disturbances drew for the episode, as JSON; empty if there are none.
    """

    task: str
    episode: int
    seed: int
    tick: int
    phase: Phase
    control_hz: float
    reward_type: RewardType
    success_rule: SuccessRule
    episode_return: float
    is_success: bool
    joint_prefix: str = JOINT_PREFIX
    disturbances: str = ''
    variation: str = ''

    def is_of_same_robot(self, other: EpisodeStatus) -> bool:
        """Return whether task, rate and joint prefix are equal, so that topics have one layout."""
        return all(
            getattr(self, name) == getattr(other, name)
            for name in ('task', 'control_hz', 'joint_prefix')
        )

    def to_values(self) -> dict[str, str]:
        """Return the key/value pairs of the message `episode_status`."""
        return {
            each.name: str(getattr(self, each.name))
            for each in fields(self)
            if getattr(self, each.name) != each.default
        }

    @classmethod
    def from_values(cls, values: Mapping[str, str]) -> EpisodeStatus:
        """Return the status in the key/value pairs of a message; raise ValueError if invalid.

        Unknown keys are ignored.
        """
        required = [each.name for each in fields(cls) if each.default is MISSING]
        if missing := [name for name in required if name not in values]:
            raise ValueError(f'episode_status without {", ".join(missing)}')
        try:
            given = [each for each in fields(cls) if each.name in values]
            status = cls(**{each.name: _read(each, values[each.name]) for each in given})
            substeps_per_tick(status.control_hz)
            check_joint_prefix(status.joint_prefix)
        except ValueError as error:
            raise ValueError(f'episode_status with {error}') from None
        return status


def _read(field: Field[Any], text: str) -> Any:
    """Return the value of a field of `EpisodeStatus`, or raise ValueError."""
    if field.name in _CHOICES:
        return one_of(text, _CHOICES[field.name], field.name)
    try:
        return _READERS[str(field.type)](text)
    except (KeyError, ValueError):
        raise ValueError(f'unreadable value: {field.name}={text[:40]!r}') from None


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """State of the simulation at one stamp.

    `reward` and `applied_command` are None at tick 0 of an episode, before the first command.

    Attributes:
        stamp_ns: Simulated time, nanoseconds.
        readings: Sensor values (topic.size,) by topic name.
        desired_goal: (goal size,).
        achieved_goal: (goal size,).
        applied_command: (action size,), command units, after clipping.
        true_readings: Readings of undisturbed sensors; None if the robot has no disturbances.
        has_diverged: Whether the simulation diverged in the last step, which ends the episode;
            state, goal and reward are those after MuJoCo's reset.
        late_commands: Number of steps of the episode whose command did not answer the latest
            observation; None in lockstep, where steps wait for commands.
    """

    stamp_ns: int
    readings: Readings
    desired_goal: Array
    achieved_goal: Array
    reward: float | None
    is_success: bool
    applied_command: Array | None
    status: EpisodeStatus
    true_readings: Readings | None = None
    has_diverged: bool = False
    late_commands: int | None = None


class TickEncoder:
    """Encodes the ticks of one task as messages."""

    def __init__(self, task: TaskSpec) -> None:
        published = [spec for spec in topics(task) if spec.direction == 'published']
        self._status = next(spec for spec in published if spec.name == 'episode_status')
        self._codecs = [TopicCodec(spec) for spec in published if spec is not self._status]
        self._true_codecs = [TopicCodec(spec) for spec in ground_truth_topics(task)]

    def encode(self, tick: Tick, latched: bool = False) -> list[tuple[TopicSpec, bytes]]:
        """Return the messages of a tick with their CDR bytes, in the order of `topics`.

        `desired_goal` is part of every tick, although it is latched. A policy that joins topics by
        stamp thus never combines a state with the goal of the previous episode. `latched` adds
        `episode_status`; use it at the reset and the end of an episode. A missing vector, or one
        of wrong size, raises ValueError.
        """
        messages = []
        # None leaves a topic out of this tick.
        vectors: dict[str, ArrayLike | None] = {
            **tick.readings,
            '/clock': [],
            'desired_goal': tick.desired_goal,
            'achieved_goal': tick.achieved_goal,
            'reward': None if tick.reward is None else [tick.reward],
            'is_success': [tick.is_success],
            'applied_command': tick.applied_command,
        }
        for codec in self._codecs:
            if codec.topic.name not in vectors:
                raise ValueError(f'no {codec.topic.name} in a tick of {tick.status.task}')
            values = vectors[codec.topic.name]
            if values is not None:
                messages.append((codec.topic, codec.encode(tick.stamp_ns, values)))
        if tick.true_readings is not None:
            for codec in self._true_codecs:
                values = tick.true_readings[codec.topic.name.removeprefix(f'{GROUND_TRUTH}/')]
                messages.append((codec.topic, codec.encode(tick.stamp_ns, values)))
        if latched:
            messages.append(self.encode_status(tick.stamp_ns, tick.status))
        return messages

    def encode_clock(self, stamp_ns: int) -> tuple[TopicSpec, bytes]:
        """Return the topic `/clock` and its message (CDR bytes), for a paused simulation."""
        clock = self._codecs[0]
        return clock.topic, clock.encode(stamp_ns, [])

    def encode_status(self, stamp_ns: int, status: EpisodeStatus) -> tuple[TopicSpec, bytes]:
        """Return the topic `episode_status` and its message (CDR bytes)."""
        message = build_status(self._status, stamp_ns, 'episode', status.to_values())
        return self._status, serialize(self._status.type_name, message)


def join_messages(messages: Sequence[tuple[TopicSpec, bytes]]) -> bytes:
    """Join the messages of a tick to one message of `latest_tick`; return its CDR bytes.

    The field `data` contains the CDR bytes of the messages in order. The field `layout` has a
    dimension for each message, with the topic name as label and the bytes as size and stride.
    """
    dimension, layout = (
        message_class(f'std_msgs/msg/MultiArray{part}') for part in ('Dimension', 'Layout')
    )
    parts = [
        dimension(label=spec.name, size=len(data), stride=len(data)) for spec, data in messages
    ]
    data = np.frombuffer(b''.join(data for _, data in messages), np.uint8)
    message = message_class(LATEST_TICK.type_name)(layout(dim=parts, data_offset=0), data)
    return serialize(LATEST_TICK.type_name, message)


def split_messages(data: bytes) -> dict[str, bytes]:
    """Return the CDR bytes of each topic in a `latest_tick`; ValueError if sizes are wrong."""
    message = deserialize(LATEST_TICK.type_name, data)
    stream, parts = BytesIO(bytes(message.data)), {}
    for part in message.layout.dim:
        parts[part.label] = found = stream.read(part.size)
        if len(found) < part.size:
            raise ValueError(f'{part.label!r} has {len(found)} bytes left, not {part.size}')
    if rest := stream.read():
        raise ValueError(f'{len(rest)} bytes belong to no topic')
    return parts
