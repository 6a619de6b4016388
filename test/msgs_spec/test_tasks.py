"""Robots, tasks and commands against the compiled models and the formulas of the benchmark."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from fetch_hand_sim.simulation.models import load_model
from msgs_spec.robots import (
    FETCH,
    FINGERTIPS,
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

MODELS = {
    'FetchReach': 'fetch/reach.xml',
    'FetchPush': 'fetch/push.xml',
    'FetchSlide': 'fetch/slide.xml',
    'FetchPickAndPlace': 'fetch/pick_and_place.xml',
    'HandReach': 'hand/reach.xml',
    'HandManipulateBlockFull': 'hand/manipulate_block.xml',
    'HandManipulateEggFull': 'hand/manipulate_egg.xml',
    'HandManipulatePenFull': 'hand/manipulate_pen.xml',
}


FETCH_MODELS = [name for name in MODELS if TASKS[name].robot is FETCH]
HAND_MODELS = [name for name in MODELS if TASKS[name].robot is SHADOW_HAND]


@pytest.fixture(scope='module', params=MODELS)
def task_and_model(request):
    return TASKS[request.param], load_model(MODELS[request.param])


def test_joints_are_the_scalar_joints_of_the_model(task_and_model):
    task, model = task_and_model
    kinds = {mujoco.mjtJoint.mjJNT_SLIDE: 'm', mujoco.mjtJoint.mjJNT_HINGE: 'rad'}
    scalar = {
        model.joint(i).name: kinds[mujoco.mjtJoint(model.jnt_type[i])]
        for i in range(model.njnt)
        if mujoco.mjtJoint(model.jnt_type[i]) in kinds
    }
    joints = zip(task.robot.joints, task.robot.joint_units, strict=True)
    # The targets and the object of some models bring joints of their own.
    ours = {name: unit for name, unit in scalar.items() if name.startswith('robot0:')}
    assert list(joints) == list(ours.items())


def test_object_is_the_free_joint_of_the_model(task_and_model):
    task, model = task_and_model
    names = [model.joint(i).name for i in range(model.njnt)]
    assert (f'{task.object_name}:joint' in names) == task.has_object
    if task.has_object:
        assert model.joint(f'{task.object_name}:joint').type == mujoco.mjtJoint.mjJNT_FREE


@pytest.mark.parametrize('task_and_model', FETCH_MODELS, indirect=True)
def test_gripper_commands_move_a_mocap_body_and_at_most_two_fingers(task_and_model):
    task, model = task_and_model
    assert model.nmocap == 1
    driven = {model.joint(model.actuator(i).trnid[0]).name for i in range(model.nu)}
    assert driven <= {name for name in task.robot.joints if 'finger' in name}
    lower, upper = command_limits(task.robot)
    np.testing.assert_array_equal(np.stack([lower, upper]), [[-1.0] * 4, [1.0] * 4])


@pytest.mark.parametrize('task_and_model', HAND_MODELS, indirect=True)
def test_hand_commands_are_the_actuators_and_their_ranges(task_and_model):
    task, model = task_and_model
    actuators = [model.actuator(i) for i in range(model.nu)]
    driven = [model.joint(actuator.trnid[0]).name for actuator in actuators]
    assert [part.name for part in task.robot.command] == driven
    assert [a.name for a in actuators] == [name.replace(':', ':A_') for name in driven]
    lower, upper = command_limits(task.robot)
    np.testing.assert_array_equal(np.stack([lower, upper], axis=1), model.actuator_ctrlrange)


@pytest.mark.parametrize('task_and_model', HAND_MODELS, indirect=True)
def test_fingertips_are_sites_at_the_ends_of_the_fingers(task_and_model):
    _, model = task_and_model
    for name in FINGERTIPS:
        body = model.body(model.site(f'robot0:S_{name}').bodyid[0])
        assert body.name == f'robot0:{name[:2]}distal'


def test_thirteen_tasks_and_their_names():
    assert len(TASKS) == 13
    assert all(task_spec(name).name == name for name in TASKS)
    with pytest.raises(ValueError, match=r"unknown task 'Fetch'; allowed: FetchReach, .*PenFull"):
        task_spec('Fetch')
    with pytest.raises(ValueError, match=r"; did you mean 'FetchPush'\?$"):
        task_spec('fetchpush')


def test_fetch_command_is_the_clipped_action_of_any_float_type():
    action = np.array([[0.5, -2.0, 1.0, 0.0]], dtype=np.float32)
    command = command_from_action(FETCH, action)
    assert command.dtype == np.float32
    np.testing.assert_array_equal(command, [[0.5, -1.0, 1.0, 0.0]])


def test_hand_command_is_the_benchmark_formula():
    action = np.random.default_rng(0).uniform(-1.5, 1.5, size=(7, 3, 20))
    model = load_model('hand/reach.xml')
    low, high = model.actuator_ctrlrange.T
    expected = (high + low) / 2.0 + np.clip(action, -1, 1) * (high - low) / 2.0
    expected = np.clip(expected, low, high)
    command = command_from_action(SHADOW_HAND, action)
    np.testing.assert_array_equal(command, expected)


@pytest.mark.parametrize('robot', [FETCH, SHADOW_HAND], ids=lambda robot: robot.name)
def test_action_and_command_are_inverse(robot):
    action = np.random.default_rng(1).uniform(-1, 1, size=(50, robot.action_size))
    command = command_from_action(robot, action)
    np.testing.assert_allclose(action_from_command(robot, command), action, atol=1e-14)
    np.testing.assert_array_equal(clip_command(robot, command), command)


def test_limits_clip_and_rest_is_the_middle():
    lower, upper = command_limits(SHADOW_HAND)
    np.testing.assert_array_equal(clip_command(SHADOW_HAND, upper + 1), upper)
    np.testing.assert_array_equal(clip_command(SHADOW_HAND, lower - 1), lower)
    np.testing.assert_allclose(resting_command(SHADOW_HAND), (lower + upper) / 2)
    np.testing.assert_array_equal(resting_command(FETCH), np.zeros(4))


@pytest.mark.parametrize(('hz', 'substeps'), [(25.0, 20), (500.0, 1), (12.5, 40), (500 / 3, 3)])
def test_whole_numbers_of_substeps(hz, substeps):
    assert substeps_per_tick(hz) == substeps


@pytest.mark.parametrize(
    ('hz', 'nearest'),
    [
        (30.0, '29.4117647 and 31.25'),
        (1000.0, '500$'),
        (400.0, '250 and 500'),
        (1.0, '12.5'),
        (0.0, '12.5'),
        (-25.0, '12.5'),
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
