"""Applied and rejected commands."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from msgs_spec.robots import CommandPart
from msgs_spec.tasks import task_spec

REACH, HAND = task_spec('FetchReach').robot, task_spec('HandReach').robot
NAMES = [part.name for part in HAND.command]


@pytest.mark.parametrize('value', [1.0, 1.0 + 1e-12, 4.9, -4.9])
def test_overshoot_of_a_controller_is_clipped_and_counted(value):
    buffer = CommandBuffer(REACH, 0.0)
    buffer.accept([value, 0.0, 0.0, 0.0])
    assert buffer.take().tolist() == [np.clip(value, -1.0, 1.0), 0.0, 0.0, 0.0]
    assert (buffer.clipped, buffer.far_out) == (abs(value) > 1.0, 0)


def test_degrees_by_mistake_are_clipped_and_reported():
    buffer = CommandBuffer(HAND, 0.0)
    buffer.accept_named(['robot0:FFJ2'], [100.0])
    assert buffer.take()[NAMES.index('robot0:FFJ2')] == HAND.command[3].upper
    assert (buffer.clipped, buffer.far_out) == (1, 1)
    assert buffer.last_far_out == 'robot0:FFJ2 is 100; allowed: 0 ... 1.571 rad'
    buffer.accept(np.zeros(20))
    assert (buffer.clipped, buffer.far_out) == (1, 1)


@pytest.mark.parametrize('value', [1e308, -1e308])
def test_the_largest_numbers_are_clipped_too(value):
    buffer = CommandBuffer(HAND, 0.0)
    buffer.accept(np.full(20, value))
    assert np.isfinite(buffer.take()).all()
    assert buffer.far_out == 1


def test_in_slow_motion_a_command_that_answers_the_last_tick_is_not_too_old():
    """At 0.02 x real time, ticks are 2 s apart and the timeout is half a second."""
    now = 0.0
    buffer = CommandBuffer(REACH, 0.5, lambda: now)
    for _ in range(3):
        buffer.accept([0.5, 0.0, 0.0, 1.0])
        now += 2.0
        assert buffer.take().tolist() == [0.5, 0.0, 0.0, 1.0]
    now += 2.0
    assert buffer.take().tolist() == [0.0, 0.0, 0.0, 1.0]


def test_a_command_is_held_after_the_timeout_and_its_age_outlives_the_episode():
    now = 5.0
    buffer = CommandBuffer(REACH, 0.5, lambda: now)
    assert buffer.age() is None
    buffer.accept([0.5, 0.0, 0.0, 1.0])
    now = 5.4
    assert buffer.take().tolist() == [0.5, 0.0, 0.0, 1.0]
    now = 6.0
    assert buffer.take().tolist() == [0.0, 0.0, 0.0, 1.0]
    buffer.start_episode([0.0, 0.0, 0.0, 0.25])
    assert buffer.take().tolist() == [0.0, 0.0, 0.0, 0.25]
    assert buffer.age() == 1.0


@pytest.mark.parametrize('names', ['xyz', ('x', 'y', 'z', 'turn'), ('gripper', 'x', 'y', 'z', 'a')])
def test_a_third_party_robot_holds_its_position_when_commands_stop(names):
    now = [0.0]
    parts = tuple(CommandPart(name, -1.0, 1.0, 'x 0.05 m') for name in names)
    buffer = CommandBuffer(replace(REACH, command=parts), 0.5, clock=lambda: now[0])
    buffer.start_episode(np.zeros(len(parts)))
    buffer.accept(np.full(len(parts), 0.7))
    assert buffer.take().tolist() == [0.7] * len(parts)
    now[0] = 1.0
    assert buffer.take().tolist() == [0.7 * (name == 'gripper') for name in names]
