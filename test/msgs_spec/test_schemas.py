"""Definitions, hashes and QoS texts against the ROS installation and independent readers."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import pytest

from msgs_spec.schemas import schema_text, type_hash
from msgs_spec.tasks import TASKS
from msgs_spec.topics import CLOCK, COMMAND, LATCHED, STATE, topics
from node_runtime.ros import rclpy_profile

TYPES = sorted({spec.type_name for task in TASKS.values() for spec in topics(task)})


def installed_type(type_name: str) -> dict[str, object]:
    """The type description that ROS itself installed."""
    package, kind, name = type_name.split('/')
    prefixes = [*filter(None, os.environ.get('AMENT_PREFIX_PATH', '').split(':')), sys.prefix]
    for prefix in prefixes:
        path = Path(prefix, 'share', package, kind, f'{name}.json')
        if path.exists():
            return json.loads(path.read_text())
    pytest.skip(f'{package} is not installed')


@pytest.mark.parametrize('type_name', TYPES)
def test_hash_is_the_one_ros_installed(type_name):
    assert installed_type(type_name)['type_hashes'][0] == {
        'type_name': type_name,
        'hash_string': type_hash(type_name),
    }


def test_an_unknown_type_is_rejected_by_name():
    with pytest.raises(ValueError, match=r"unknown message type 'nav/Goal'; allowed: .*Jazzy"):
        schema_text('nav/Goal')


@pytest.mark.parametrize('spec', [STATE, LATCHED, COMMAND, CLOCK])
def test_rclpy_profile_has_the_same_policies(spec):
    pytest.importorskip('rclpy')
    profile = rclpy_profile(spec)
    assert profile.history.short_key == 'keep_last'
    assert profile.depth == spec.depth
    assert profile.reliability.short_key == spec.reliability
    assert profile.durability.short_key == spec.durability
