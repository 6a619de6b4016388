"""All messages of a tick in one, `latest_tick`, for those who need not see every tick.

Whoever follows a robot by its topics is woken for each message of each tick, which on a machine
with few processors costs the robot more than sending them.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from msgs_spec.schemas import deserialize, message_class, serialize
from msgs_spec.topics import LATEST_TICK, TopicSpec

_STD = 'std_msgs/msg/'


def join_messages(messages: Sequence[tuple[TopicSpec, bytes]]) -> bytes:
    """CDR bytes of `latest_tick`.

    Its `data` are the CDR bytes of the messages, one after the other; its `layout` has a dimension
    for each: the name of the topic as label, and its number of bytes as size and stride.

    Args:
        messages: Topics and CDR bytes.
    """
    dimension, layout = (
        message_class(f'{_STD}MultiArray{part}') for part in ('Dimension', 'Layout')
    )
    parts = [
        dimension(label=spec.name, size=len(data), stride=len(data)) for spec, data in messages
    ]
    data = np.frombuffer(b''.join(data for _, data in messages), np.uint8)
    message = message_class(LATEST_TICK.type_name)(layout(dim=parts, data_offset=0), data)
    return serialize(LATEST_TICK.type_name, message)


def split_messages(data: bytes) -> dict[str, bytes]:
    """Returns the CDR bytes of each topic in a `latest_tick`, in their order.

    Raises:
        ValueError: If the bytes are no such message, or sizes do not add up.
    """
    message = deserialize(LATEST_TICK.type_name, data)
    rest, parts = bytes(message.data), {}
    for part in message.layout.dim:
        if part.size > len(rest):
            raise ValueError(f'{part.label!r} has {len(rest)} bytes left, not {part.size}')
        parts[part.label], rest = rest[: part.size], rest[part.size :]
    if rest:
        raise ValueError(f'{len(rest)} bytes belong to no topic')
    return parts
