"""How nodes reach others: on this machine unless somebody wants more, and not by shared memory.

With shared memory a writer depends on its readers: Fast DDS 2.14 asks a reader that it writes to
whether it is alive and waits up to a second for the answer, takes a lock in the reader's segment,
and where the reader was stopped opens that segment again for every message. A viewer that was
stopped took a quarter of the ticks of a robot in lockstep (`make bench-view` stops one), and
killed ones have held robots up for seconds. Over UDP neither is noticed, and messages as small as
those of a robot travel as fast.
"""

from __future__ import annotations

import os
from collections.abc import MutableMapping
from pathlib import Path

_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
# Who sets one of these has decided; the last two count only where the range is left to ROS.
_DECISIONS = (_PROFILES, _TRANSPORTS, 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
_LAST_DOMAIN = '232'
_UDP_ONLY = Path(__file__).with_name('fastdds_udp.xml')


def keep_discovery_local(environment: MutableMapping[str, str] = os.environ) -> None:
    """Keeps robots on this machine unless the user chose a discovery range."""
    environment.setdefault(_RANGE, 'LOCALHOST')


def leave_out_shared_memory(environment: MutableMapping[str, str] = os.environ) -> None:
    """Has Fast DDS use UDP alone, unless the user chose transports or another middleware.

    Call it before rclpy is initialised, and after `keep_discovery_local`.
    """
    middleware = environment.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    if not middleware.startswith('rmw_fastrtps') or any(map(environment.get, _DECISIONS)):
        return
    if environment.get(_RANGE) != 'LOCALHOST':
        environment[_TRANSPORTS] = 'UDPv4'
    # The last domain has no ports for as many participants as the profile looks for.
    elif environment.get('ROS_DOMAIN_ID') != _LAST_DOMAIN:
        # For this range rmw_fastrtps adds shared memory whatever the variables say: the profile
        # takes the place of the range.
        environment[_RANGE] = 'SYSTEM_DEFAULT'
        environment[_PROFILES] = str(_UDP_ONLY)
