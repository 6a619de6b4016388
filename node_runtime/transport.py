"""Discovery on this machine only by default, and Fast DDS without shared memory.

With shared memory, a writer of Fast DDS 2.14 waits up to a second for stopped readers and takes
locks in their segments. A stopped viewer cost a robot in lockstep a quarter of its ticks
(`make bench-view`), and killed viewers blocked robots for seconds. UDP avoids both and is as fast
for messages of a robot's size.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
# Each of these is a choice of the user; the last two count only where the range is ROS's default.
_DECISIONS = (_PROFILES, _TRANSPORTS, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
_LAST_DOMAIN = '232'
_UDP_ONLY = Path(__file__).with_name('fastdds_udp.xml')


def keep_discovery_local(environment: MutableMapping[str, str] = os.environ) -> None:
    """Restrict discovery to this machine unless the user chose a range."""
    environment.setdefault(_RANGE, 'LOCALHOST')


def leave_out_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Make Fast DDS use UDP alone unless the user chose transports or another middleware.

    Call it before rclpy is initialised and after `keep_discovery_local`.
    """
    middleware = environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    if not middleware.startswith('rmw_fastrtps') or any(map(environment.get, _DECISIONS)):
        return
    if environment.get(_RANGE) != 'LOCALHOST':
        environment[_TRANSPORTS] = 'UDPv4'
    # The last domain has no ports for as many participants as the profile looks for.
    elif environment.get('ROS_DOMAIN_ID') != _LAST_DOMAIN:
        # rmw_fastrtps always adds shared memory for LOCALHOST; the profile replaces the range.
        environment[_RANGE] = 'SYSTEM_DEFAULT'
        environment[_PROFILES] = str(_UDP_ONLY)
