"""Robots, tasks and commands against the compiled models and the formulas of the benchmark."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.simulation.models import load_model
from fetch_hand_sim.simulation.tasks.registry import task_asset
from msgs_spec.robots import (
    FETCH,
    JOINT_PREFIX,
    SHADOW_HAND,
    action_from_command,
    clip_command,
    command_from_action,
    command_limits,
    read_joint_prefix,
    resting_command,
)
from msgs_spec.tasks import TASKS, substeps_per_tick, task_spec
from support.tasks import FAMILIES


@pytest.mark.parametrize('task', FAMILIES)
def test_joints_are_those_of_the_model(task):
    model, robot = load_model(task_asset(task)), TASKS[task].robot
    kinds = {mujoco.mjtJoint.mjJNT_SLIDE.value: 'm', mujoco.mjtJoint.mjJNT_HINGE.value: 'rad'}
    joints = [model.joint(i) for i in range(model.njnt)]
    # The targets and the object of some models bring joints of their own.
    expected = {
        each.name: kinds[each.type.item()] for each in joints if each.name.startswith('robot0:')
    }
    assert list(zip(robot.joints, robot.joint_units, strict=True)) == list(expected.items())


@pytest.mark.parametrize('robot', [FETCH, SHADOW_HAND], ids=lambda robot: robot.name)
def test_commands_are_the_formula_of_the_benchmark_with_the_ranges_of_the_model(robot):
    low, high = -np.ones(4), np.ones(4)
    if robot is SHADOW_HAND:
        model = load_model('hand/reach.xml')
        driven = [model.joint(model.actuator(i).trnid[0]).name for i in range(model.nu)]
        assert [part.name for part in robot.command] == driven
        low, high = model.actuator_ctrlrange.T
    np.testing.assert_array_equal(command_limits(robot), [low, high])
    action = np.random.default_rng(0).uniform(-1.5, 1.5, size=(7, 3, robot.action_size))
    clipped = np.clip(action, -1.0, 1.0)
    command = command_from_action(robot, action)
    expected = (high + low) / 2.0 + clipped * (high - low) / 2.0
    np.testing.assert_array_equal(command, np.clip(expected, low, high))
    np.testing.assert_allclose(action_from_command(robot, command), clipped, atol=1e-14)
    np.testing.assert_array_equal(clip_command(robot, command), command)
    np.testing.assert_array_equal(clip_command(robot, [low - 1, high + 1]), [low, high])
    np.testing.assert_allclose(resting_command(robot), (low + high) / 2)
    # The benchmark scales actions of the Fetch in their own type.
    assert command_from_action(FETCH, np.zeros(4, np.float32)).dtype == np.float32


def test_thirteen_tasks_and_their_names():
    assert len(TASKS) == 13
    assert all(task_spec(name).name == name for name in TASKS)
    with pytest.raises(ValueError, match=r"unknown task 'Fetch'; allowed: FetchReach, .*PenFull"):
        task_spec('Fetch')
    with pytest.raises(ValueError, match=r"; did you mean 'FetchPush'\?$"):
        task_spec('fetchpush')


@pytest.mark.parametrize(('hz', 'substeps'), [(25.0, 20), (500.0, 1), (12.5, 40), (500 / 3, 3)])
def test_whole_numbers_of_substeps(hz, substeps):
    assert substeps_per_tick(hz) == substeps


@pytest.mark.parametrize(
    ('hz', 'nearest'),
    [
        (30.0, '29.4117647 and 31.25'),
        (1000.0, '500$'),
        (0.0, '12.5'),
        (5e-324, '12.5'),
        (float('nan'), '12.5'),
        (float('inf'), '500'),
    ],
)
def test_other_rates_are_refused_with_the_nearest(hz, nearest):
    with pytest.raises(ValueError, match=f'allowed: 500/n Hz .*nearest: .*{nearest}'):
        substeps_per_tick(hz)


def test_a_joint_prefix_that_renames_no_joint_is_rejected():
    for robot in (FETCH, SHADOW_HAND):
        assert read_joint_prefix(robot, 'rh_') == 'rh_'
    arm = replace(FETCH, name='arm', joints=('shoulder', 'elbow'))
    for value in ('model', JOINT_PREFIX):
        assert read_joint_prefix(arm, value) == JOINT_PREFIX
    with pytest.raises(ValueError, match=r"'rh_' .* arm .*; allowed: 'model'"):
        read_joint_prefix(arm, 'rh_')
