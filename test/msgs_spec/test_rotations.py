"""Rotations against Gymnasium-Robotics and MuJoCo, bit for bit."""

from __future__ import annotations

import platform

import mujoco
import numpy as np
import pytest
from gymnasium_robotics.envs.shadow_dexterous_hand.manipulate import quat_from_angle_and_axis
from gymnasium_robotics.utils import rotations as reference

from msgs_spec import rotations
from support.same_bits import assert_same

COUNT = 2000


def random_quaternions(seed):
    quaternions = np.random.default_rng(seed).normal(size=(COUNT, 4))
    quaternions /= np.linalg.norm(quaternions, axis=-1, keepdims=True)
    quaternions[:4] = np.eye(4)
    return quaternions


def random_eulers():
    eulers = np.random.default_rng(1).uniform(-np.pi, np.pi, size=(COUNT, 3))
    # Gimbal lock, exactly and nearly.
    eulers[:4, 1] = [np.pi / 2, -np.pi / 2, np.pi / 2 - 1e-9, -np.pi / 2 + 1e-9]
    return eulers


CASES = {
    'quaternion_multiply': (
        rotations.quaternion_multiply,
        reference.quat_mul,
        [random_quaternions(0), random_quaternions(1)],
    ),
    'quaternion_to_euler': (
        rotations.quaternion_to_euler,
        reference.quat2euler,
        [random_quaternions(0) * 1.7],
    ),
    'matrix_to_euler': (
        rotations.matrix_to_euler,
        reference.mat2euler,
        [
            np.concatenate(
                [reference.quat2mat(random_quaternions(0)), reference.euler2mat(random_eulers())]
            )
        ],
    ),
    'euler_to_quaternion': (rotations.euler_to_quaternion, reference.euler2quat, [random_eulers()]),
}


@pytest.mark.parametrize(('ours', 'theirs', 'arguments'), CASES.values(), ids=CASES)
def test_equals_gymnasium_robotics_in_batches_of_any_shape(ours, theirs, arguments):
    expected = theirs(*arguments)
    assert_same(ours(*arguments), expected)
    batch = ours(*(a[:60].reshape(3, 20, *a.shape[1:]) for a in arguments))
    assert_same(batch, expected[:60].reshape(batch.shape))
    assert_same(np.stack([ours(*row) for row in zip(*arguments, strict=True)]), expected)


@pytest.mark.skipif(
    platform.machine() not in ('x86_64', 'AMD64'), reason='other compilers may contract to FMA'
)
def test_quaternion_to_matrix_equals_mujoco():
    quaternions = random_quaternions(0)
    expected = np.empty((COUNT, 9))
    for quaternion, matrix in zip(quaternions, expected, strict=True):
        mujoco.mju_quat2Mat(matrix, quaternion)
    assert_same(rotations.quaternion_to_matrix(quaternions).reshape(COUNT, 9), expected)


def test_quaternion_from_axis_angle_equals_the_reference_to_the_last_bit():
    """As the reference draws the start of an object: one by one."""
    generator = np.random.default_rng(7)
    for _ in range(COUNT):
        angle, axis = generator.uniform(-np.pi, np.pi), generator.uniform(-1.0, 1.0, size=3)
        ours = rotations.quaternion_from_axis_angle(axis, angle)
        assert_same(ours, quat_from_angle_and_axis(angle, axis))


def test_rotation_angle_of_both_conventions():
    first = random_quaternions(4)[4:]
    angle = np.random.default_rng(5).uniform(0.1, 3.0, size=len(first))
    turn = rotations.quaternion_from_axis_angle([1.0, -2.0, 0.5], angle)
    second = rotations.quaternion_multiply(turn, first)
    for sign, raw in ((1, angle), (-1, 2 * np.pi - angle)):
        rotation = rotations.rotation_angle(sign * second, first, antipodal=True)
        np.testing.assert_allclose(rotation, angle, atol=1e-7)
        quaternion = rotations.rotation_angle(sign * second, first, antipodal=False)
        np.testing.assert_allclose(quaternion, raw, atol=1e-7)
