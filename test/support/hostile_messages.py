"""Messages that no well-meaning program sends: wrong sizes, values and names, damaged bytes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.codecs import build_message, build_status
from msgs_spec.schemas import message_class, serialize
from msgs_spec.tasks import task_spec
from msgs_spec.topics import TopicSpec, topic

POLICY_STATUS = topic(task_spec('FetchReach'), 'policy_status')
VALUES = [math.nan, math.inf, -math.inf, 5e-324, -5e-324, 1e308, -1e308, 0.0, -0.0, 1.0, 1e-310]


def hostile_bytes(generator: np.random.Generator, spec: TopicSpec) -> bytes:
    """A message of a topic that a robot listens to, of the right type more often than not."""
    return damaged(generator, serialize(spec.type_name, _message(generator, spec)))


def damaged(generator: np.random.Generator, data: bytes) -> bytes:
    """The bytes, every twentieth time cut off or with wrong ones among them."""
    if generator.random() > 0.05:
        return data
    found = bytearray(data)
    found[generator.integers(len(found))] ^= 0xFF
    return bytes(found[: generator.integers(len(found))])


def introduction(sha256: str) -> Any:
    """Return the status message of a policy node."""
    return build_status(POLICY_STATUS, 0, 'policy', {'checkpoint_sha256': sha256})


def _message(generator: np.random.Generator, spec: TopicSpec) -> Any:
    if spec.name == 'commands':
        array = message_class(spec.type_name)
        layout = message_class('std_msgs/msg/MultiArrayLayout')(dim=[], data_offset=2**32 - 1)
        return array(layout=layout, data=_vector(generator, spec.size))
    if spec.name == 'joint_commands':
        names = [*spec.names, '', 'robot0:', '\N{SNOWMAN}' * 100, spec.names[0]]
        chosen = [str(name) for name in generator.choice(names, generator.integers(0, 24))]
        message = build_message(spec, 0, np.zeros(spec.size))
        message.name, message.position = chosen, _vector(generator, len(chosen))
        return message
    if spec.name == 'policy_status':
        return introduction('' if generator.random() < 0.5 else 'not a fingerprint')
    values = _vector(generator, spec.size)
    return build_message(spec, 0, np.resize(values, spec.size) if values.size else [0] * spec.size)


def _vector(generator: np.random.Generator, size: int) -> NDArray[np.float64]:
    length = int(generator.choice([size, size, size, 0, 1, abs(size - 1), size + 1, 1000]))
    if generator.random() < 0.5:
        return generator.uniform(-2.0, 2.0, length)
    return generator.choice(VALUES, length)
