"""Float64 vectors from the bytes of single messages, as they arrive.

A message laid out like this project's own differs from them in the stamp and in the numbers only,
so these are picked out at known places: a tenth of the time of filling a message object. Anything
else goes the long way through `schemas` and `codecs`.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError

from msgs_spec.cdr import TopicEncoder
from msgs_spec.codecs import decode, message_stamp
from msgs_spec.schemas import deserialize
from msgs_spec.topics import TopicSpec

Array = NDArray[np.float64]

# Alignment counts from the end of the encapsulation header. A stamp comes first.
_BODY = 4
_STAMP = struct.Struct('<iI')
# What `deserialize` raises for bytes that are not such a message; asserts find bytes left over.
_UNREADABLE = (
    AssertionError,
    IndexError,
    MemoryError,
    SerdeError,
    UnicodeDecodeError,
    ValueError,
    struct.error,
)
# Two stamps and two numbers that differ in every byte, to find what is fixed in a message.
_STAMPS = tuple(0x01010101 * n * (10**9 + 1) for n in (1, 2))
_NUMBERS = tuple(np.frombuffer(bytes([n] * 8), '<f8')[0] for n in (1, 2))


class TopicDecoder:
    """Decodes the messages of one topic whose type has a header.

    Args:
        topic: Any topic with a header but those of type DiagnosticArray.
    """

    def __init__(self, topic: TopicSpec) -> None:
        self._topic = topic
        encoder = TopicEncoder(topic)
        low, high = (
            np.frombuffer(encoder.encode(stamp, np.full(topic.size, number)), np.uint8)
            for stamp, number in zip(_STAMPS, _NUMBERS, strict=True)
        )
        self._size = low.size
        self._fixed = np.flatnonzero(low == high)
        self._template = low[self._fixed]
        self._floats = (low.size - _BODY) // 8
        markers = np.pi * np.arange(1, topic.size + 1)
        marked = np.frombuffer(encoder.encode(0, markers), '<f8', self._floats, _BODY)
        self._slots = np.array([int(np.flatnonzero(marked == m)[0]) for m in markers], dtype=int)

    def decode(self, data: bytes) -> tuple[int, Array]:
        """Returns the stamp in nanoseconds and the vector (topic.size,) of a message.

        Args:
            data: CDR bytes with their encapsulation header.

        Raises:
            ValueError: If they are no such message or do not fit the topic.
        """
        if len(data) == self._size:
            found = np.frombuffer(data, np.uint8)
            if np.array_equal(found[self._fixed], self._template):
                seconds, nanoseconds = _STAMP.unpack_from(data, _BODY)
                floats = np.frombuffer(data, '<f8', self._floats, _BODY)
                return seconds * 10**9 + nanoseconds, floats[self._slots]
        return self._decode_other(data)

    def _decode_other(self, data: bytes) -> tuple[int, Array]:
        try:
            message = deserialize(self._topic.type_name, data)
        except _UNREADABLE as error:
            raise ValueError(f'{self._topic.name}: unreadable message: {error}') from None
        return message_stamp(message), decode(self._topic, message)
