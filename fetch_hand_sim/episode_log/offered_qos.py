"""Quality of service that was offered for a topic, as rosbag2 writes it down."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any

import yaml

from msgs_spec.topics import QosSpec

# libyaml is six times as fast as pure Python.
_Loader: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)
# A list of profiles with nine keys, three of whose values have keys of their own: ours has 400
# bytes.
_LONGEST = 4096
_DEEPEST = 3
# rmw's infinity: a duration that nobody has set.
_UNSET = {'sec': 9223372036, 'nsec': 854775807}


@dataclass(frozen=True, slots=True)
class OfferedQos:
    """The offers of the publishers of a topic.

    Attributes:
        profiles: Profiles of rosbag2 metadata version 9, for `metadata.yaml`.
        text: The same as YAML text, for the channel of an MCAP file.
    """

    profiles: Sequence[Mapping[str, Any]]
    text: str


@cache
def offered_qos(spec: QosSpec) -> OfferedQos:
    """Returns the offer of one publisher."""
    profile = {
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
    return OfferedQos([profile], yaml.safe_dump([profile], sort_keys=False))


@lru_cache(maxsize=64)
def parse_offered_qos(text: str) -> OfferedQos:
    """Returns what an `offered_qos_profiles` lists; the text may be anybody's.

    Raises:
        ValueError: If it is no list of profiles, too long or deep, or refers to itself: a few
            hundred bytes of anchors unfold to gigabytes.
    """
    if len(text) > _LONGEST:
        raise ValueError(f'quality of service of {len(text)} bytes; allowed: {_LONGEST}')
    try:
        _require_plain(text)
        profiles = yaml.load(text, Loader=_Loader) or []
    except yaml.YAMLError as error:
        raise ValueError(f'quality of service is no YAML: {error}') from None
    if not isinstance(profiles, list) or not all(isinstance(each, dict) for each in profiles):
        raise ValueError('quality of service is no list of profiles')
    return OfferedQos(profiles, text)


def _require_plain(text: str) -> None:
    """Refuses aliases, tags and deep nesting before anything is built of them."""
    depth = 0
    for event in yaml.parse(text, Loader=_Loader):
        if isinstance(event, yaml.AliasEvent):
            raise ValueError('quality of service with an alias')
        tag = getattr(event, 'tag', None)
        if tag is not None:
            # Some make other errors than those of YAML where a value does not fit them.
            raise ValueError(f'quality of service with the tag {tag}')
        depth += isinstance(event, yaml.CollectionStartEvent)
        depth -= isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise ValueError(f'quality of service nested more than {_DEEPEST} deep')
