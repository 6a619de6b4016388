"""Quality of service of topics as data, and for rclpy."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile


@dataclass(frozen=True, slots=True)
class QosSpec:
    """What a publisher offers; history is always keep_last.

    Attributes:
        depth: Messages kept.
        reliability: Whether lost messages are sent again.
        durability: `transient_local` topics are latched: late subscribers get the last messages.
    """

    depth: int
    reliability: Literal['reliable', 'best_effort']
    durability: Literal['volatile', 'transient_local']


# All offers are reliable: a best-effort publisher silently starves reliable subscribers, while a
# reliable one serves both kinds.
STATE = QosSpec(depth=10, reliability='reliable', durability='volatile')
LATCHED = QosSpec(depth=1, reliability='reliable', durability='transient_local')
# Named joint commands add up, and a rejected one is to be counted, so none may push another out.
COMMAND = QosSpec(depth=10, reliability='reliable', durability='volatile')
CLOCK = QosSpec(depth=1, reliability='reliable', durability='volatile')


def rclpy_profile(spec: QosSpec) -> QoSProfile:
    """Returns the profile for rclpy's `create_publisher` and `create_subscription`."""
    from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=spec.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(spec.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(spec.durability),
    )
