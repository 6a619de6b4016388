"""By default, nodes stay on this machine and do not use shared memory."""

from __future__ import annotations

from pathlib import Path

import pytest

import node_runtime
from node_runtime.ros import keep_discovery_local, leave_out_shared_memory

RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
PROFILES = 'FASTRTPS_DEFAULT_PROFILES_FILE'
TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
MIDDLEWARE = 'RMW_IMPLEMENTATION'
UDP_ONLY = str(Path(node_runtime.__file__).with_name('fastdds_udp.xml'))


@pytest.mark.parametrize(('before', 'after'), [(None, 'LOCALHOST'), ('SUBNET', 'SUBNET')])
def test_discovery_stays_on_this_machine_unless_asked(before, after):
    environment = {RANGE: before} if before else {}
    keep_discovery_local(environment)
    assert environment == {RANGE: after}


@pytest.mark.parametrize(
    ('given', 'added'),
    [
        ({RANGE: 'LOCALHOST'}, {RANGE: 'SYSTEM_DEFAULT', PROFILES: UDP_ONLY}),
        ({RANGE: 'SUBNET'}, {TRANSPORTS: 'UDPv4'}),
        ({RANGE: 'SUBNET', MIDDLEWARE: 'rmw_fastrtps_dynamic_cpp'}, {TRANSPORTS: 'UDPv4'}),
        ({RANGE: 'LOCALHOST', MIDDLEWARE: 'rmw_cyclonedds_cpp'}, {}),
        ({RANGE: 'LOCALHOST', PROFILES: 'mine.xml'}, {}),
        ({RANGE: 'LOCALHOST', 'ROS_DOMAIN_ID': '232'}, {}),
        ({RANGE: 'SUBNET', 'ROS_DOMAIN_ID': '232'}, {TRANSPORTS: 'UDPv4'}),
        ({RANGE: 'LOCALHOST', TRANSPORTS: 'DEFAULT'}, {}),
        ({RANGE: 'LOCALHOST', 'ROS_STATIC_PEERS': '192.0.2.1'}, {}),
    ],
)
def test_shared_memory_is_left_out_unless_the_user_has_decided(given, added):
    environment = dict(given)
    leave_out_shared_memory(environment)
    assert environment == given | added
