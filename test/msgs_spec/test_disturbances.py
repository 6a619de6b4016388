"""Disturbances as data: forms that users give, scaling, and bad input."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from msgs_spec.disturbances import PRESETS, Disturbances, read_disturbances


@pytest.mark.parametrize('name', PRESETS)
def test_a_preset_survives_yaml(name: str, tmp_path: Path) -> None:
    path = tmp_path / 'disturbances.yaml'
    path.write_text(yaml.safe_dump(PRESETS[name].as_dict()))
    assert read_disturbances(str(path)) == PRESETS[name] == read_disturbances(name)


@pytest.mark.parametrize('given', [None, '', 'off', {}, '{}', 'hardware*0'])
def test_off_disturbs_nothing(given: str | None) -> None:
    assert read_disturbances(given).is_off


def test_one_number_stands_for_a_range() -> None:
    found = read_disturbances('{"action": {"latency": 2}, "physics": {"friction": [0.5, 2]}}')
    assert found.action.latency == (2, 2)
    assert found.physics.friction == (0.5, 2.0)


def test_numpy_numbers_are_plain_ones() -> None:
    noise = np.float32(0.25)
    found = read_disturbances({'action': {'latency': list(np.arange(1, 3)), 'noise': noise}})
    assert found.as_dict() == {'action': {'latency': [1, 2], 'noise': 0.25}}
    assert Disturbances.from_json(found.to_json()) == found


def test_scaling_follows_the_meaning_of_a_field() -> None:
    given = Disturbances.from_dict(
        {'action': {'latency': 1, 'drop': 0.6}, 'physics': {'friction': [0.5, 1.0]}}
    )
    scaled = given.scaled(2.0)
    assert scaled.action.latency == (2, 2)
    assert scaled.action.drop == 1.0
    assert scaled.physics.friction == (0.25, 1.0)


@pytest.mark.parametrize(
    ('given', 'named'),
    [
        ('hardwar', 'hardware'),
        ('hardware*x', "'x'"),
        ('{"acton": {}}', "'action'"),
        ('{"action": {"delay": 1}}', 'latency'),
        ('{"action": {"latency": 9}}', 'action.latency=9'),
        ('{"action": {"latency": 0.5}}', '0.5'),
        ('{"joints": {"noise": -1}}', 'joints.noise=-1'),
        ('{"joints": {"noise": NaN}}', 'nan'),
        ('{"physics": {"friction": [2, 1]}}', '[2, 1]'),
        ('{"physics": 3}', "'3'"),
        ('{broken', 'JSON'),
        ('{action: !!bool x}', 'YAML'),
        ('{action: {latency: [&a [1, 2], *a]}}', 'aliases are not allowed'),
        # A regular file whose first bytes cannot be read.
        ('/proc/self/mem', '/proc/self/mem: Input/output error'),
    ],
)
def test_bad_input_is_one_line_that_names_the_value(given: str, named: str) -> None:
    with pytest.raises(ValueError) as raised:
        read_disturbances(given)
    assert named in str(raised.value)
    assert '\n' not in str(raised.value)
