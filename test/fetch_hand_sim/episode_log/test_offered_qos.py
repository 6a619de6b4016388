"""What a log says of the quality of service of its topics."""

from __future__ import annotations

import pytest
import yaml

from fetch_hand_sim.episode_log.offered_qos import offered_qos, parse_offered_qos
from msgs_spec.topics import CLOCK, COMMAND, LATCHED, STATE


def test_text_is_metadata_version_9():
    assert offered_qos(LATCHED).text == (
        '- history: keep_last\n'
        '  depth: 1\n'
        '  reliability: reliable\n'
        '  durability: transient_local\n'
        '  deadline:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  lifespan:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  liveliness: automatic\n'
        '  liveliness_lease_duration:\n'
        '    sec: 9223372036\n'
        '    nsec: 854775807\n'
        '  avoid_ros_namespace_conventions: false\n'
    )


@pytest.mark.parametrize('spec', [STATE, LATCHED, COMMAND, CLOCK])
def test_text_and_profiles_say_the_same(spec):
    offered = offered_qos(spec)
    assert yaml.safe_load(offered.text) == offered.profiles == [dict(offered.profiles[0])]
    assert parse_offered_qos(offered.text) == offered
    assert offered.profiles[0]['depth'] == spec.depth
    assert offered.profiles[0]['durability'] == spec.durability
