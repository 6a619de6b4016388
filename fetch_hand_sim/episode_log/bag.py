"""Write MCAP files and their `metadata.yaml` as rosbag2, rosbags and Foxglove expect them.

The files have the profile `ros2`, `ros2msg` schemas and `cdr` messages. Each channel records the
quality of service and the type hash. Chunks have a CRC and message indexes. The summary repeats
schemas and channels and contains statistics.
"""

from __future__ import annotations

import errno
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, BinaryIO

import yaml
from mcap.writer import CompressionType, IndexType, Writer

from fetch_hand_sim.episode_log.records import (
    MAX_CHUNKS,
    MAX_MAP_ENTRIES,
    MAX_MESSAGES,
    MAX_METADATA_BYTES,
    MAX_TOPICS,
    MAX_UNPACKED_BYTES,
)
from msgs_spec.schemas import MAX_MESSAGE_BYTES, schema_text, type_hash
from msgs_spec.topics import QosSpec, TopicSpec

# Names of the metadata records; of the two `rosbag2` ones readers take the last.
EPISODE, EPISODE_RESULT, ROSBAG2 = 'episode', 'episode_result', 'rosbag2'

# Bytes of messages per chunk; small chunks keep the longest write short.
CHUNK_BYTES, COMPRESSION = 128 * 1024, CompressionType.LZ4
_ALL_BUT_ATTACHMENTS = IndexType.ALL & ~IndexType.ATTACHMENT
# Bytes in a chunk beside the data of a message, and at most for the first message of a topic.
_MESSAGE_BYTES = 1 + 8 + 2 + 4 + 8 + 8
_TOPIC_BYTES = 2**16
_TOO_LONG = (
    f'the episode is too long for a file of {MAX_MESSAGES} messages and '
    f'{MAX_UNPACKED_BYTES // 2**20} MiB of them'
)
# Version of rosbag2's `metadata.yaml` in ROS 2 Jazzy.
_VERSION, _ROS_DISTRO = 9, 'jazzy'
# Infinite duration of rmw: no limit is set.
_UNSET = {'sec': 9223372036, 'nsec': 854775807}
# libyaml takes 1 ms where pure Python takes 6 ms, a good part of a tick.
_SafeDumper: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)


@dataclass(frozen=True, slots=True)
class Attachment:
    """A file stored with the episode; `media_type` is its MIME type."""

    name: str
    media_type: str
    data: bytes


@cache
def offered_qos(spec: QosSpec) -> list[dict[str, Any]]:
    """Return `spec` as a list of one QoS profile, with every key that rosbag2 writes."""
    return [
        {
            'history': 'keep_last',
            'depth': spec.depth,
            'reliability': spec.reliability,
            'durability': spec.durability,
            'deadline': dict(_UNSET),
            'lifespan': dict(_UNSET),
            'liveliness': 'automatic',
            'liveliness_lease_duration': dict(_UNSET),
            'avoid_ros_namespace_conventions': False,
        }
    ]


@cache
def offered_qos_text(spec: QosSpec) -> str:
    """Return `offered_qos` as YAML text, the value `offered_qos_profiles` of a channel."""
    return yaml.safe_dump(offered_qos(spec), sort_keys=False)


def checked_strings(content: Mapping[str, str]) -> dict[str, str]:
    """Copy metadata; ValueError above `MAX_METADATA_BYTES` bytes or `MAX_MAP_ENTRIES` entries."""
    size = sum(len(text.encode()) for item in content.items() for text in item)
    if size > MAX_METADATA_BYTES:
        raise ValueError(f'{size} bytes of episode metadata; allowed: {MAX_METADATA_BYTES}')
    if len(content) > MAX_MAP_ENTRIES:
        raise ValueError(f'{len(content)} entries of metadata; allowed: {MAX_MAP_ENTRIES}')
    return dict(content)


@dataclass(slots=True)
class _Channel:
    """A channel of the MCAP file; `name` is the full topic name, `count` the messages so far."""

    name: str
    topic: TopicSpec
    id: int
    count: int = 0


class BagFile:
    """Writes one episode as an MCAP file into an open stream, which the caller closes.

    An `OSError` of the stream is raised; nothing can be written after it. Metadata (the record
    `episode`) and attachments are written first, so that a cut-off file also contains them.
    `file_name` is the name of the file in `metadata.yaml`.
    """

    def __init__(
        self,
        stream: BinaryIO,
        file_name: str,
        metadata: dict[str, str],
        attachments: Sequence[Attachment],
    ) -> None:
        self._stream = stream
        self._file_name = file_name
        self._metadata = metadata
        self._writer = Writer(
            stream,
            chunk_size=CHUNK_BYTES,
            compression=COMPRESSION,
            # Validators reject an empty index of attachments.
            index_types=IndexType.ALL if attachments else _ALL_BUT_ATTACHMENTS,
            enable_data_crcs=True,
        )
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, _Channel] = {}
        self._start_ns = 0
        self._end_ns = -1
        self._bytes = self._flushes = 0
        self.message_count = 0
        self.has_unflushed = False
        self._writer.start(profile='ros2')
        self._writer.add_metadata(EPISODE, metadata)
        self._writer.add_metadata(ROSBAG2, self._rosbag2_record(metadata))
        for attachment in attachments:
            # No time: an attachment holds for the whole file.
            self._writer.add_attachment(
                0, 0, attachment.name, attachment.media_type, attachment.data
            )
        self.flush()

    def write(self, name: str, topic: TopicSpec, data: bytes, log_time_ns: int) -> None:
        """Append a message; the first message of a topic also creates its channel.

        Sequence numbers count the messages of a topic from 0, so a gap is visible.

        Raises:
            OSError: If the stream fails, `has_room` is False, or topics would exceed `MAX_TOPICS`.
                If `has_room` is False, all earlier messages are flushed first.
        """
        if not self.has_room(len(data)):
            self.flush()
            raise OSError(errno.EFBIG, _TOO_LONG)
        channel = self._channels.get(name) or self._add_channel(name, topic)
        self._writer.add_message(channel.id, log_time_ns, data, log_time_ns, channel.count)
        if self._end_ns < 0:
            self._start_ns = log_time_ns
        self._end_ns = log_time_ns
        channel.count += 1
        self.message_count += 1
        self.has_unflushed = True
        self._bytes += _MESSAGE_BYTES + len(data)

    @property
    def chunks(self) -> int:
        """Upper bound of the number of chunks so far, including the one in progress."""
        return self._flushes + self._bytes // CHUNK_BYTES + 1

    def has_room(self, size: int) -> bool:
        """Return whether the file stays within its limits with another message of `size` bytes."""
        return (
            size <= MAX_MESSAGE_BYTES
            and self.message_count < MAX_MESSAGES
            and self._bytes + _TOPIC_BYTES + _MESSAGE_BYTES + size <= MAX_UNPACKED_BYTES
            and self.chunks < MAX_CHUNKS
        )

    def flush(self) -> None:
        """End the current chunk and pass all data to the operating system, without fsync."""
        self._flushes += self.has_unflushed
        self.has_unflushed = False
        self._writer.flush()  # type: ignore[no-untyped-call]

    def finish(self, result: dict[str, str]) -> str:
        """Complete the file, with `result` as a metadata record; return `metadata.yaml` as text."""
        self.flush()
        custom_data = {**self._metadata, **result}
        self._writer.add_metadata(EPISODE_RESULT, result)
        self._writer.add_metadata(ROSBAG2, self._rosbag2_record(custom_data))
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._stream.flush()
        return _dump({'rosbag2_bagfile_information': self._description(custom_data)})

    def _add_channel(self, name: str, topic: TopicSpec) -> _Channel:
        if len(self._channels) == MAX_TOPICS:
            raise OSError(errno.EFBIG, f'an episode has at most {MAX_TOPICS} topics')
        text, qos = schema_text(topic.type_name), offered_qos_text(topic.qos)
        texts = (name, topic.type_name, text, qos, type_hash(topic.type_name))
        self._bytes += 4 * 64 + sum(len(each.encode()) for each in texts)
        if topic.type_name not in self._schemas:
            self._schemas[topic.type_name] = self._writer.register_schema(
                topic.type_name, 'ros2msg', text.encode()
            )
        id = self._writer.register_channel(
            name,
            'cdr',
            self._schemas[topic.type_name],
            {'offered_qos_profiles': qos, 'topic_type_hash': type_hash(topic.type_name)},
        )
        return self._channels.setdefault(name, _Channel(name, topic, id))

    def _rosbag2_record(self, custom_data: Mapping[str, str]) -> dict[str, str]:
        return {'serialized_metadata': _dump(self._description(custom_data))}

    def _description(self, custom_data: Mapping[str, str]) -> dict[str, Any]:
        """Return `metadata.yaml` with `custom_data`; rosbag2's format version 9 needs every key."""
        span = {
            'starting_time': {'nanoseconds_since_epoch': self._start_ns},
            'duration': {'nanoseconds': max(self._end_ns, 0) - self._start_ns},
            'message_count': self.message_count,
        }
        return {
            'version': _VERSION,
            'storage_identifier': 'mcap',
            **span,
            'topics_with_message_count': [_topic_entry(each) for each in self._channels.values()],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [self._file_name],
            'files': [{'path': self._file_name, **span}],
            'custom_data': {key: _Quoted(value) for key, value in custom_data.items()},
            'ros_distro': _ROS_DISTRO,
        }


def _topic_entry(channel: _Channel) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': channel.name,
            'type': channel.topic.type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': offered_qos(channel.topic.qos),
            'type_description_hash': type_hash(channel.topic.type_name),
        },
        'message_count': channel.count,
    }


class _Quoted(str):
    """Text that YAML quotes; unquoted, a revision such as 12e4567 would be read as a number."""


class _Dumper(_SafeDumper):  # type: ignore[misc]
    """YAML dumper that writes repeated parts in full, without anchors and aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    _Quoted,
    lambda dumper, text: dumper.represent_scalar('tag:yaml.org,2002:str', str(text), style='"'),
)


def _dump(content: Mapping[str, Any]) -> str:
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True))
