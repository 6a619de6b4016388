"""What rosbag2 wants to know about a bag, version 9 of its `metadata.yaml` (ROS 2 Jazzy)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import yaml

VERSION = 9
ROS_DISTRO = 'jazzy'

# libyaml takes 1 ms where pure Python takes 6 ms, a good part of a tick.
_SafeDumper: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)
_SafeLoader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
# A list of profiles with nine keys, two of whose values have keys of their own: ours has 400 bytes.
_LONGEST_QOS = 4096
_DEEPEST_QOS = 3


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """One topic of a bag.

    Attributes:
        topic: Resolved name, with a leading slash.
        type_name: ROS name of the message type.
        qos_yaml: `offered_qos_profiles` as YAML text, a list of profiles.
        type_hash: RIHS01 hash of the type.
        message_count: Messages of this topic in the bag.
    """

    topic: str
    type_name: str
    qos_yaml: str
    type_hash: str
    message_count: int


@dataclass(frozen=True, slots=True)
class BagInfo:
    """The contents of a bag that is one file.

    Attributes:
        file_name: Name of the file in the bag directory.
        start_ns: Log time of the first message, 0 if there is none.
        end_ns: Log time of the last message, 0 if there is none.
        channels: The topics, in order of their first message.
    """

    file_name: str
    start_ns: int
    end_ns: int
    channels: Sequence[ChannelInfo]

    @property
    def message_count(self) -> int:
        """Messages in the bag."""
        return sum(channel.message_count for channel in self.channels)


@lru_cache(maxsize=64)
def qos_profiles(text: str) -> list[dict[str, Any]]:
    """Returns the profiles that an `offered_qos_profiles` lists; the text may be anybody's.

    Raises:
        ValueError: If it is no such list, too long or deep, or refers to itself: a few hundred
            bytes of anchors unfold to gigabytes.
    """
    if len(text) > _LONGEST_QOS:
        raise ValueError(f'quality of service of {len(text)} bytes; allowed: {_LONGEST_QOS}')
    try:
        _require_plain(text)
        profiles = yaml.load(text, Loader=_SafeLoader) or []
    except yaml.YAMLError as error:
        raise ValueError(f'quality of service is no YAML: {error}') from None
    if not isinstance(profiles, list) or not all(isinstance(each, dict) for each in profiles):
        raise ValueError('quality of service is no list of profiles')
    return profiles


def _require_plain(text: str) -> None:
    """Refuses aliases and deep nesting before anything is built of them."""
    depth = 0
    for event in yaml.parse(text, Loader=_SafeLoader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError('quality of service with an alias')
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST_QOS:
            raise ValueError(f'quality of service nested more than {_DEEPEST_QOS} deep')


def _topic_entry(channel: ChannelInfo) -> dict[str, Any]:
    return {
        'topic_metadata': {
            'name': channel.topic,
            'type': channel.type_name,
            'serialization_format': 'cdr',
            'offered_qos_profiles': qos_profiles(channel.qos_yaml),
            'type_description_hash': channel.type_hash,
        },
        'message_count': channel.message_count,
    }


def bag_metadata(info: BagInfo, custom_data: Mapping[str, str]) -> dict[str, Any]:
    """Returns rosbag2's description of a bag; readers of version 9 miss any key left out."""
    span = {
        'starting_time': {'nanoseconds_since_epoch': info.start_ns},
        'duration': {'nanoseconds': info.end_ns - info.start_ns},
        'message_count': info.message_count,
    }
    return {
        'version': VERSION,
        'storage_identifier': 'mcap',
        **span,
        'topics_with_message_count': [_topic_entry(channel) for channel in info.channels],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [info.file_name],
        'files': [{'path': info.file_name, **span}],
        'custom_data': {key: _Quoted(value) for key, value in custom_data.items()},
        'ros_distro': ROS_DISTRO,
    }


class _Quoted(str):
    """A string that stays one: a revision such as 12e4567 is a number to readers of YAML 1.2."""


class _Dumper(_SafeDumper):  # type: ignore[misc]
    """Writes repeated parts in full instead of as anchors."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


_Dumper.add_representer(
    _Quoted,
    lambda dumper, text: dumper.represent_scalar('tag:yaml.org,2002:str', str(text), style='"'),
)


def _dump(content: Mapping[str, Any]) -> str:
    return str(yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True))


def metadata_record(info: BagInfo, custom_data: Mapping[str, str]) -> dict[str, str]:
    """Returns the contents of the MCAP metadata record `rosbag2`."""
    return {'serialized_metadata': _dump(bag_metadata(info, custom_data))}


def metadata_yaml(info: BagInfo, custom_data: Mapping[str, str]) -> str:
    """Returns the text of `metadata.yaml`."""
    return _dump({'rosbag2_bagfile_information': bag_metadata(info, custom_data)})
