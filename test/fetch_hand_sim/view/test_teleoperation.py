"""Arrow keys command: positions go on and stay, moves last as long as the key."""

from __future__ import annotations

import numpy as np
import pytest

from fetch_hand_sim.view.page.command_panel import Teleoperation
from msgs_spec.robots import FETCH, SHADOW_HAND

FRAME = 1.0 / 60.0


def hold(teleoperation, direction, seconds):
    for _ in range(round(seconds / FRAME)):
        teleoperation.hold(direction, FRAME)


def test_an_axis_of_fetch_moves_while_the_key_is_held():
    keys = Teleoperation(FETCH, None)
    keys.hold(1, FRAME)
    assert keys.values.tolist()[:3] == [1.0, 0.0, 0.0]
    keys.hold(-1, FRAME)
    assert keys.values.tolist()[:3] == [-1.0, 0.0, 0.0]
    keys.hold(0, FRAME)
    assert keys.values.tolist()[:3] == [0.0, 0.0, 0.0]


def test_an_axis_starts_at_rest_and_the_gripper_as_it_is():
    keys = Teleoperation(FETCH, np.array([1.0, -1.0, 0.5, -0.7]))
    assert keys.values.tolist() == [0.0, 0.0, 0.0, -0.7]


def test_a_joint_goes_on_and_stays_within_its_limits():
    keys = Teleoperation(SHADOW_HAND, None)
    keys.select(3)
    part, before = SHADOW_HAND.command[3], keys.values.copy()
    hold(keys, 1, 0.5)
    step = keys.values[3] - before[3]
    assert step == pytest.approx(0.25 * (part.upper - part.lower), rel=0.05)
    keys.hold(0, FRAME)
    assert keys.values[3] - before[3] == step
    hold(keys, 1, 3.0)
    assert keys.values[3] == part.upper
    hold(keys, -1, 3.0)
    assert keys.values[3] == part.lower
    others = np.delete(np.arange(len(before)), 3)
    np.testing.assert_array_equal(keys.values[others], before[others])


@pytest.mark.parametrize('robot', [FETCH, SHADOW_HAND])
def test_choosing_wraps_around(robot):
    keys = Teleoperation(robot, None)
    keys.select(-1)
    assert keys.selected == len(robot.command) - 1
    keys.select(1)
    assert keys.selected == 0
