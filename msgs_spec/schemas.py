"""Message definitions by type name: schema text, type hash, CDR bytes.

The definitions are those of ROS 2 Jazzy as the `rosbags` package carries them, so logs can be
written and read without a ROS installation. Types are named as ROS names them:
`sensor_msgs/msg/JointState`.
"""

from __future__ import annotations

import struct
from functools import cache
from typing import Any

from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

# The longest message that a robot sends or understands has 3 KB; what is longer than this is
# dropped before it is decoded or logged.
MAX_MESSAGE_BYTES = 64 * 2**10
# What the type store raises for bytes that are not such a message; asserts find bytes left over.
_UNREADABLE = (AssertionError, IndexError, MemoryError, SerdeError, struct.error)


@cache
def _store() -> Typestore:
    return get_typestore(Stores.ROS2_JAZZY)


def message_class(type_name: str) -> Any:
    """Returns the dataclass that stands for messages of a type outside of rclpy.

    Raises:
        ValueError: If the type is not part of ROS 2 Jazzy.
    """
    try:
        return _store().types[type_name]
    except KeyError:
        raise ValueError(
            f'unknown message type {type_name!r}; allowed: types of ROS 2 Jazzy, '
            'such as sensor_msgs/msg/JointState'
        ) from None


@cache
def schema_text(type_name: str) -> str:
    """Returns the `ros2msg` text of a type and of all types it is made of, as MCAP wants it."""
    message_class(type_name)
    return _store().generate_msgdef(type_name, ros_version=2)[0]


@cache
def type_hash(type_name: str) -> str:
    """Returns the type hash of REP 2016, `RIHS01_` and 64 hexadecimal digits."""
    message_class(type_name)
    return _store().hash_rihs01(type_name)


def require_short(data: bytes) -> None:
    """Refuses what takes longer to read than a tick lasts.

    Raises:
        ValueError: If there are more than `MAX_MESSAGE_BYTES`.
    """
    if len(data) > MAX_MESSAGE_BYTES:
        raise ValueError(f'{len(data)} bytes given; allowed: up to {MAX_MESSAGE_BYTES}')


def serialize(type_name: str, message: object) -> bytes:
    """Returns the CDR bytes (little endian, with encapsulation header) of a message.

    Args:
        type_name: Type of the message.
        message: An instance of `message_class(type_name)`.
    """
    return bytes(_store().serialize_cdr(message, type_name, little_endian=True))


def deserialize(type_name: str, data: bytes) -> Any:
    """Returns the message in `data` as an instance of `message_class(type_name)`.

    Raises:
        ValueError: If the bytes are not such a message, or there is no such type.
    """
    message_class(type_name)
    try:
        return _store().deserialize_cdr(data, type_name)
    except _UNREADABLE as error:
        raise ValueError(f'no readable {type_name}: {error}') from None
