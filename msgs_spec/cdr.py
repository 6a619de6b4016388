"""CDR bytes of topics at the rate of the simulation.

The bytes of a message with a fixed layout differ in the stamp and in the numbers only. So a message
is serialised once, the places of its numbers are found, and from then on they are overwritten in a
copy: 2 to 25 times as fast as filling a message and serialising it, and without the uninitialised
bytes that `rclpy.serialization.serialize_message` leaves at the end. What comes out can be logged
and given to `Publisher.publish` as it is.
"""

from __future__ import annotations

import struct

import numpy as np
from numpy.typing import ArrayLike, NDArray

from msgs_spec.codecs import build_message, checked_size
from msgs_spec.schemas import serialize
from msgs_spec.topics import TopicSpec

# Alignment counts from the end of the encapsulation header. A stamp, if there is one, comes first.
_BODY = 4
_STAMP = struct.Struct('<iI')
_FLOAT = struct.Struct('<d')

Array = NDArray[np.float64]


class LayoutError(ValueError):
    """Messages of a topic are not laid out as this project writes them."""


class TopicEncoder:
    """Encodes the vectors of one topic, one at a time, and decodes messages, all at once.

    Args:
        topic: Any topic but those of type DiagnosticArray.
    """

    def __init__(self, topic: TopicSpec) -> None:
        self._topic = topic
        self._is_bool = topic.type_name == 'std_msgs/msg/Bool'
        markers = np.pi * np.arange(1, topic.size + 1)
        self._template = serialize(topic.type_name, build_message(topic, 0, markers))
        self._has_stamp = self._template != serialize(
            topic.type_name, build_message(topic, 1, markers)
        )
        self._floats = (len(self._template) - _BODY) // _FLOAT.size
        self._slots = np.array([] if self._is_bool else list(map(self._slot, markers)), dtype=int)
        self._fixed = self._fixed_bytes()

    def encode(self, stamp: int, values: ArrayLike) -> bytes:
        """Returns the bytes of `codecs.build_message` with the same arguments."""
        vector = checked_size(self._topic, values)
        data = bytearray(self._template)
        if self._has_stamp:
            _STAMP.pack_into(data, _BODY, *divmod(stamp, 10**9))
        if self._is_bool:
            data[_BODY] = bool(vector[0])
        else:
            np.frombuffer(data, '<f8', self._floats, _BODY)[self._slots] = vector
        return bytes(data)

    @property
    def size(self) -> int:
        """Bytes of a message."""
        return len(self._template)

    def decode(self, messages: NDArray[np.uint8]) -> tuple[NDArray[np.int64] | None, Array]:
        """Decodes messages of this encoder at array speed.

        Args:
            messages: (n, size).

        Returns:
            Stamps (n,) in nanoseconds, None for types without a stamp, and vectors
            (n, topic.size), equal to those of `codecs.decode`.

        Raises:
            LayoutError: If a message differs from the template in anything but stamp and numbers:
                other names, frame or sizes. `codecs.decode` may still read it.
        """
        if messages.ndim != 2 or messages.shape[1] != self.size:
            raise LayoutError(f'{self._topic.name}: {messages.shape[-1]} bytes, not {self.size}')
        template = np.frombuffer(self._template, np.uint8)
        if ((messages != template) & self._fixed).any():
            raise LayoutError(f'{self._topic.name}: not the layout of this project')
        body = np.ascontiguousarray(messages[:, _BODY:])
        if self._is_bool:
            return None, (body[:, :1] != 0).astype(np.float64)
        stamps = None
        if self._has_stamp:
            seconds, nanoseconds = body[:, :8].copy().view('<u4').astype(np.int64).T
            stamps = seconds * 10**9 + nanoseconds
        floats = np.ascontiguousarray(body[:, : self._floats * _FLOAT.size]).view('<f8')
        return stamps, floats[:, self._slots].astype(np.float64)

    def _fixed_bytes(self) -> NDArray[np.bool_]:
        """Which bytes are the same in all messages."""
        fixed = np.ones(self.size, dtype=bool)
        if self._has_stamp:
            fixed[_BODY : _BODY + _STAMP.size] = False
        if self._is_bool:
            fixed[_BODY] = False
        for slot in self._slots:
            start = _BODY + _FLOAT.size * int(slot)
            fixed[start : start + _FLOAT.size] = False
        return fixed

    def _slot(self, marker: float) -> int:
        """Index of a marker among the float64 places of the body."""
        pattern = _FLOAT.pack(marker)
        offset = self._template.find(pattern) - _BODY
        if self._template.count(pattern) != 1 or offset % _FLOAT.size:
            raise RuntimeError(f'{self._topic.name}: cannot place {marker} in the template')
        return offset // _FLOAT.size
