"""The additional inputs: how far the goal is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from msgs_spec.rotations import (
    quaternion_conjugate,
    quaternion_from_axis_angle,
    quaternion_multiply,
    quaternion_to_matrix,
)
from msgs_spec.tasks import TASKS, GoalKind, task_spec
from policy_node.policies.goal_features import RelativeGoal, goal_features
from support.tasks import each_task

POSE_TASKS = [name for name, spec in TASKS.items() if spec.goal is GoalKind.POSE]


def _observation(task: str, achieved: np.ndarray) -> torch.Tensor:
    """Observations (..., size) with these achieved goals (..., goal size)."""
    spec = task_spec(task)
    row = np.random.default_rng(1).normal(size=spec.observation_size)
    observation = np.tile(row, (*achieved.shape[:-1], 1))
    start = spec.achieved_goal_start
    observation[..., start : start + spec.goal.size] = achieved
    return torch.from_numpy(observation)


def _difference(task: str, achieved: np.ndarray, goal: np.ndarray) -> np.ndarray:
    features = goal_features('relative', task_spec(task))
    assert isinstance(features, RelativeGoal)
    return features.difference(_observation(task, achieved), torch.from_numpy(goal)).numpy()


def _pose(position: object, quaternion: object) -> np.ndarray:
    return np.concatenate([position, quaternion], dtype=float)


@each_task
def test_the_achieved_goal_is_at_its_specified_place(task: str) -> None:
    from fetch_hand_sim.simulation import Simulation

    simulation = Simulation(task, num_envs=2)
    observation = simulation.reset(seed=3)
    spec = simulation.spec
    part = slice(spec.achieved_goal_start, spec.achieved_goal_start + spec.goal.size)
    assert (observation['observation'][:, part] == observation['achieved_goal']).all()


def test_rotation_is_goal_times_conjugate_with_its_sign() -> None:
    achieved = quaternion_from_axis_angle([1, 2, 3], 0.4)
    for sign in (1.0, -1.0):
        goal = sign * quaternion_from_axis_angle([0.1, -0.1, 0.6], 2.0)
        poses = (_pose(np.zeros(3), quaternion) for quaternion in (achieved, goal))
        values = _difference('HandManipulateBlockFull', *poses)
        expected = quaternion_multiply(goal, quaternion_conjugate(achieved))
        np.testing.assert_allclose(values[:4], expected, atol=1e-12)
        np.testing.assert_allclose(values[4:7], np.clip(10 * expected[1:], -5, 5), atol=1e-12)


def test_position_counts_only_in_tasks_that_specify_it() -> None:
    achieved, goal = (_pose(place, [1, 0, 0, 0]) for place in ([0, 0, 0], [0.01, -0.02, 0.5]))
    for task in POSE_TASKS:
        wanted = [0.5, -1.0, 5.0] if task.endswith('Full') else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(_difference(task, achieved, goal)[7:], wanted, atol=1e-12)


def test_turning_the_pen_about_its_own_axis_changes_nothing() -> None:
    start = quaternion_from_axis_angle([1, 1, 0], 0.7)
    turned = quaternion_multiply(start, quaternion_from_axis_angle([0, 0, 1], 1.3))
    goal = _pose(np.zeros(3), quaternion_from_axis_angle([1, 0, 0], 1))
    poses = np.stack([_pose(np.zeros(3), quaternion) for quaternion in (start, turned)])
    first, second = _difference('HandManipulatePenFull', poses, np.stack([goal, goal]))
    np.testing.assert_allclose(first, second, atol=1e-12)
    assert abs(first[0]) < 0.999


def test_points_are_differences() -> None:
    values = _difference('FetchSlide', np.array([1.0, 0.5, 0.4]), np.array([1.6, 0.49, 0.4]))
    np.testing.assert_allclose(values, [0.6, -0.01, 0, 5.0, -0.1, 0], atol=1e-12)


def _pose_inputs(task: str, pose: np.ndarray, angular: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Symmetric inputs of poses (..., 7), an angular velocity (object frame) and a goal."""
    spec = task_spec(task)
    features = goal_features('symmetric', spec)
    assert features is not None
    observation = _observation(task, pose)
    start = spec.achieved_goal_start
    observation[..., start - 3 : start] = torch.from_numpy(angular)
    arguments = observation, torch.from_numpy(np.broadcast_to(goal, pose.shape).copy())
    return features.inputs(arguments, arguments).numpy()


def _cube_rotations() -> list[np.ndarray]:
    quarter = [quaternion_from_axis_angle(axis, np.pi / 2) for axis in np.eye(3)]
    found = [np.array([1.0, 0.0, 0.0, 0.0])]
    for rotation in found:
        for turn in quarter:
            candidate = quaternion_multiply(rotation, turn)
            if all(abs(candidate @ other) < 0.99 for other in found):
                found.append(candidate)
    return found


def _symmetries(task: str) -> list[np.ndarray]:
    if 'Block' in task:
        return _cube_rotations()
    about = [quaternion_from_axis_angle([0, 0, 1], angle) for angle in (0.4, 2.0, -1.1)]
    upside_down = quaternion_from_axis_angle([1, 0, 0], np.pi)
    return [*about, upside_down, quaternion_multiply(upside_down, about[0])]


@pytest.mark.parametrize(
    'task', ['HandManipulateBlockFull', 'HandManipulateEggFull', 'HandManipulatePenFull']
)
def test_poses_that_look_alike_are_one_and_others_are_not(task: str) -> None:
    generator = np.random.default_rng(2)
    pose, goal = generator.normal(size=7), generator.normal(size=7)
    for each in (pose, goal):
        each[3:] /= np.linalg.norm(each[3:])
    angular = generator.normal(size=3)
    before = _pose_inputs(task, pose, angular, goal)
    symmetries = _symmetries(task)
    assert len(symmetries) == (24 if 'Block' in task else 5)
    for symmetry in symmetries:
        turned, turned_goal = pose.copy(), goal.copy()
        turned[3:] = quaternion_multiply(pose[3:], symmetry)
        turned_goal[3:] = quaternion_multiply(goal[3:], symmetry)
        seen = quaternion_to_matrix(symmetry).T @ angular
        np.testing.assert_allclose(
            _pose_inputs(task, turned, seen, turned_goal), before, atol=1e-12
        )
    other = pose.copy()
    other[3:] = quaternion_multiply(pose[3:], quaternion_from_axis_angle([1, 0.2, 0], 0.3))
    assert np.abs(_pose_inputs(task, other, angular, goal) - before).max() > 0.1


def test_all_rotations_of_a_cube_but_its_symmetries_differ() -> None:
    spec = task_spec('HandManipulateBlockRotateXYZ')
    poses = np.random.default_rng(3).normal(size=(200, 7))
    poses[:, :3] = 0.0
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    # After the position and the angular velocity.
    first = spec.achieved_goal_start + 3
    goal = _pose(np.zeros(3), [1, 0, 0, 0])
    shapes = _pose_inputs(spec.name, poses, np.zeros(3), goal)[:, first : first + 15]
    distances = np.linalg.norm(shapes[:, None] - shapes, axis=-1)
    np.fill_diagonal(distances, np.inf)
    assert distances.min() > 0.02
    assert np.std(shapes, axis=0).min() > 0.2
