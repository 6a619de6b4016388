"""One MCAP file as rosbag2, rosbags and Foxglove want it.

Profile `ros2`, `ros2msg` schemas, `cdr` messages, quality of service and type hash per channel,
chunks with CRC and message index, schemas and channels repeated in the summary, statistics, CRC of
all data. Knows nothing of episodes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import BinaryIO, Literal

from mcap.writer import CompressionType, IndexType, Writer

from fetch_hand_sim.episode_log.bag_metadata import BagInfo, ChannelSpec
from fetch_hand_sim.episode_log.limits import (
    MAX_CHUNKS,
    MAX_MESSAGES,
    MAX_TOPICS,
    MAX_UNPACKED_BYTES,
)
from msgs_spec.schemas import MAX_MESSAGE_BYTES

Compression = Literal['none', 'lz4', 'zstd']
COMPRESSIONS = {
    'none': CompressionType.NONE,
    'lz4': CompressionType.LZ4,
    'zstd': CompressionType.ZSTD,
}
_ALL_BUT_ATTACHMENTS = IndexType.ALL & ~IndexType.ATTACHMENT
# Bytes in a chunk beside the data of a message, and at most for the first message of a topic.
_MESSAGE_BYTES = 1 + 8 + 2 + 4 + 8 + 8
_TOPIC_BYTES = 2**16


def _topic_bytes(spec: ChannelSpec) -> int:
    """Bytes of the schema and the channel of a topic, with some to spare."""
    texts = (spec.topic, spec.type_name, spec.schema_text, spec.qos.text, spec.type_hash)
    return 4 * 64 + sum(len(text.encode()) for text in texts)


@dataclass(slots=True)
class _Channel:
    spec: ChannelSpec
    id: int
    count: int = 0


class BagFile:
    """Writes messages to an open stream, whose `OSError`s come through and end the file.

    Args:
        stream: Where to write; stays the caller's to flush and close.
        file_name: Name of the file in its bag directory.
        chunk_size: Bytes of messages after which a chunk is compressed and written.
        compression: Of the chunks.
        has_attachments: Whether there will be any; validators reject an empty index of them.

    Attributes:
        has_unflushed: Whether there are messages that the operating system does not have yet.
    """

    def __init__(
        self,
        stream: BinaryIO,
        file_name: str,
        chunk_size: int,
        compression: Compression,
        has_attachments: bool,
    ) -> None:
        self._file_name = file_name
        self._writer = Writer(
            stream,
            chunk_size=chunk_size,
            compression=COMPRESSIONS[compression],
            index_types=IndexType.ALL if has_attachments else _ALL_BUT_ATTACHMENTS,
            enable_data_crcs=True,
        )
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._start_ns = 0
        self._end_ns = -1
        self._chunk_size = chunk_size
        self._messages = self._bytes = self._chunks = self._chunk_bytes = 0
        self.has_unflushed = False
        self._writer.start(profile='ros2')

    def write(self, spec: ChannelSpec, data: bytes, log_time_ns: int) -> None:
        """Appends a message; the first of a topic makes its channel: readers reject empty ones.

        The sequence number counts the messages of the channel from 0, so a reader can prove that
        none is missing.

        Raises:
            ValueError: If the time is not later than that of the message before, or readers would
                refuse the file; nothing is written then.
        """
        if log_time_ns <= self._end_ns:
            raise ValueError(
                f'log time {log_time_ns} ns of {spec.topic} is not later than the one before it, '
                f'{self._end_ns} ns'
            )
        if exceeded := self._exceeded(len(data)):
            raise ValueError(f'{spec.topic}: no reader takes {exceeded}')
        channel = self._channels.get(spec.topic) or self._add_channel(spec)
        self._writer.add_message(
            channel_id=channel.id,
            log_time=log_time_ns,
            data=data,
            publish_time=log_time_ns,
            sequence=channel.count,
        )
        if self._end_ns < 0:
            self._start_ns = log_time_ns
        self._end_ns = log_time_ns
        channel.count += 1
        self._messages += 1
        self.has_unflushed = True
        self._count_bytes(_MESSAGE_BYTES + len(data))

    @property
    def chunks(self) -> int:
        """Chunks so far, the one in progress counted."""
        return self._chunks + (self._chunk_bytes > 0)

    def takes(self, size: int) -> bool:
        """Whether readers take the file with one more message of `size` bytes."""
        return not self._exceeded(size)

    def _exceeded(self, size: int) -> str:
        """What would be too much with one more message of `size` bytes; empty if nothing."""
        counts = (
            (size, MAX_MESSAGE_BYTES, 'bytes in a message'),
            (self._messages + 1, MAX_MESSAGES, 'messages in a file'),
            (
                self._bytes + _TOPIC_BYTES + _MESSAGE_BYTES + size,
                MAX_UNPACKED_BYTES,
                'bytes of messages in a file',
            ),
            (self.chunks + 1, MAX_CHUNKS, 'chunks in a file'),
        )
        for count, limit, what in counts:
            if count > limit:
                return f'{count} {what}; allowed: up to {limit}'
        return ''

    def _count_bytes(self, size: int) -> None:
        self._bytes += size
        self._chunk_bytes += size
        if self._chunk_bytes > self._chunk_size:
            self._end_chunk()

    def _end_chunk(self) -> None:
        self._chunks += self._chunk_bytes > 0
        self._chunk_bytes = 0

    def _add_channel(self, spec: ChannelSpec) -> _Channel:
        if len(self._channels) >= MAX_TOPICS:
            raise ValueError(f'{spec.topic}: no reader takes more than {MAX_TOPICS} topics')
        if (size := _topic_bytes(spec)) > _TOPIC_BYTES:
            raise ValueError(
                f'{spec.topic}: schema and channel of {size} bytes; allowed: up to {_TOPIC_BYTES}'
            )
        if spec.type_name not in self._schemas:
            self._schemas[spec.type_name] = self._writer.register_schema(
                name=spec.type_name, encoding='ros2msg', data=spec.schema_text.encode()
            )
        channel_id = self._writer.register_channel(
            topic=spec.topic,
            message_encoding='cdr',
            schema_id=self._schemas[spec.type_name],
            metadata={
                'offered_qos_profiles': spec.qos.text,
                'topic_type_hash': spec.type_hash,
            },
        )
        self._channels[spec.topic] = channel = _Channel(spec, channel_id)
        self._count_bytes(_topic_bytes(spec))
        return channel

    def add_record(self, name: str, content: dict[str, str]) -> None:
        """Writes a metadata record."""
        self._writer.add_metadata(name, content)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Writes an attachment, with no time: what is attached holds for the whole file."""
        self._writer.add_attachment(
            create_time=0, log_time=0, name=name, media_type=media_type, data=data
        )

    def flush(self) -> None:
        """Ends the chunk in progress and hands everything to the operating system."""
        self._end_chunk()
        self.has_unflushed = False
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self) -> None:
        """Writes the last chunk and the summary."""
        self._writer.finish()  # type: ignore[no-untyped-call]

    @property
    def info(self) -> BagInfo:
        """What is in the file so far."""
        return BagInfo(
            file_name=self._file_name,
            start_ns=self._start_ns,
            end_ns=max(self._end_ns, 0),
            channels=[(channel.spec, channel.count) for channel in self._channels.values()],
        )
