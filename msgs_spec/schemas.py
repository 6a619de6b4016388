"""Message classes, schema texts, type hashes and CDR conversion by ROS type name.

The definitions of ROS 2 Jazzy come from the `rosbags` package, so logs can be written and read
without ROS.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

# Longer messages are dropped before they are decoded or logged. The longest valid one has 3 KB.
MAX_MESSAGE_BYTES = 64 * 2**10
# Errors of the type store for invalid bytes; its assertions detect surplus bytes.
_UNREADABLE = (AssertionError, IndexError, MemoryError, SerdeError, struct.error)


@cache
def _store() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def message_class(type_name: str) -> Any:
    """Return the dataclass for messages of a type of ROS 2 Jazzy, or raise ValueError."""
    try:
        return _store().types[type_name]
    except KeyError:
        raise ValueError(
            f'unknown message type {type_name!r}; allowed: types of ROS 2 Jazzy, '
            'such as sensor_msgs/msg/JointState'
        ) from None


@cache
def schema_text(type_name: str) -> str:
    """Return the `ros2msg` text of a type and its nested types, for MCAP, or raise ValueError."""
    message_class(type_name)
    return _store().generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Return the type hash of REP 2016 (`RIHS01_` and 64 hex digits), or raise ValueError."""
    message_class(type_name)
    return _store().hash_rihs01(type_name)


def require_short(data: bytes) -> None:
    """Raise ValueError for messages above `MAX_MESSAGE_BYTES`; these take too long to decode."""
    if len(data) > MAX_MESSAGE_BYTES:
        raise ValueError(f'{len(data)} bytes given; allowed: up to {MAX_MESSAGE_BYTES}')


def serialize(type_name: str, message: object) -> bytes:
    """Return a message, an instance of `message_class`, as little-endian CDR bytes with header."""
    return bytes(_store().serialize_cdr(message, type_name, little_endian=True))


def deserialize(type_name: str, data: bytes) -> Any:
    """Return the message in CDR bytes, an instance of `message_class`, or raise ValueError."""
    message_class(type_name)
    try:
        return _store().deserialize_cdr(data, type_name)
    except _UNREADABLE as error:
        raise ValueError(f'no readable {type_name}: {error}') from None
