"""The additional inputs: how far the goal is."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from msgs_spec.rotations import (
    quaternion_conjugate,
    quaternion_from_axis_angle,
    quaternion_multiply,
)
from msgs_spec.tasks import TASKS, GoalKind, task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.goal_features import RelativeGoal, goal_features
from policy_node.policies.network_shape import NetworkShape
from support.tasks import each_task


def relative_goal(task: str) -> RelativeGoal:
    features = goal_features('relative', task_spec(task))
    assert isinstance(features, RelativeGoal)
    return features


POSE_TASKS = [name for name, spec in TASKS.items() if spec.goal is GoalKind.POSE]


def _observation(task: str, achieved: np.ndarray) -> torch.Tensor:
    spec = task_spec(task)
    observation = np.random.default_rng(1).normal(size=spec.observation_size)
    start = spec.achieved_goal_start
    observation[start : start + spec.goal.size] = achieved
    return torch.from_numpy(observation)


@each_task
def test_the_achieved_goal_is_at_its_specified_place(task: str) -> None:
    from fetch_hand_sim.simulation import Simulation

    simulation = Simulation(task, num_envs=2)
    observation = simulation.reset(seed=3)
    spec = simulation.spec
    part = slice(spec.achieved_goal_start, spec.achieved_goal_start + spec.goal.size)
    assert (observation['observation'][:, part] == observation['achieved_goal']).all()


@pytest.mark.parametrize('kind', ['plain', 'relative', 'symmetric'])
@pytest.mark.parametrize('task', list(TASKS))
def test_the_number_of_inputs_matches_the_shape(task: str, kind: str) -> None:
    spec = task_spec(task)
    if kind == 'symmetric' and task not in POSE_TASKS:
        with pytest.raises(ValueError, match='no object pose'):
            goal_features(kind, spec)
        return
    sizes = (spec.observation_size, spec.goal.size)
    features = goal_features(kind, spec)
    shape = NetworkShape(*sizes, spec.robot.action_size, (8,), goal_features=features)
    actor = Actor(shape)
    inputs = actor.features(torch.zeros(4, 2, sizes[0]), torch.zeros(4, 2, sizes[1]))
    assert inputs.shape == (4, 2, shape.feature_size)
    assert actor(inputs).shape == (4, 2, spec.robot.action_size)


def test_rotation_is_goal_times_conjugate_with_its_sign() -> None:
    generator = np.random.default_rng(0)
    achieved = np.concatenate([np.zeros(3), quaternion_from_axis_angle([1, 2, 3], 0.4)])
    for sign in (1.0, -1.0):
        quaternion = sign * quaternion_from_axis_angle(generator.normal(size=3), 2.0)
        goal = np.concatenate([np.zeros(3), quaternion])
        observation = _observation('HandManipulateBlockFull', achieved)
        features = relative_goal('HandManipulateBlockFull').difference
        values = features(observation, torch.from_numpy(goal)).numpy()
        expected = quaternion_multiply(quaternion, quaternion_conjugate(achieved[3:]))
        np.testing.assert_allclose(values[:4], expected, atol=1e-12)
        np.testing.assert_allclose(values[4:7], np.clip(10 * expected[1:], -5, 5), atol=1e-12)


def test_position_counts_only_in_tasks_that_specify_it() -> None:
    achieved, goal = np.zeros(7), np.array([0.01, -0.02, 0.5, 1.0, 0.0, 0.0, 0.0])
    achieved[3] = 1.0
    for task in POSE_TASKS:
        values = relative_goal(task).difference(
            _observation(task, achieved), torch.from_numpy(goal)
        )
        wanted = [0.5, -1.0, 5.0] if task.endswith('Full') else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(values[7:], wanted, atol=1e-12)


def test_turning_the_pen_about_its_own_axis_changes_nothing() -> None:
    features = relative_goal('HandManipulatePenFull').difference
    start = quaternion_from_axis_angle([1, 1, 0], 0.7)
    goal = torch.from_numpy(np.concatenate([np.zeros(3), quaternion_from_axis_angle([1, 0, 0], 1)]))
    turned = quaternion_multiply(start, quaternion_from_axis_angle([0, 0, 1], 1.3))
    first, second = (
        features(_observation('HandManipulatePenFull', np.concatenate([np.zeros(3), q])), goal)
        for q in (start, turned)
    )
    np.testing.assert_allclose(first, second, atol=1e-12)
    assert abs(float(first[0])) < 0.999


def test_points_are_differences() -> None:
    features = relative_goal('FetchSlide').difference
    observation = _observation('FetchSlide', np.array([1.0, 0.5, 0.4]))
    values = features(observation, torch.tensor([1.6, 0.49, 0.4], dtype=torch.float64))
    np.testing.assert_allclose(values, [0.6, -0.01, 0, 5.0, -0.1, 0], atol=1e-12)


def _pose_inputs(task: str, pose: np.ndarray, angular: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Symmetric inputs of an object pose, angular velocity (object frame) and goal."""
    spec = task_spec(task)
    features = goal_features('symmetric', spec)
    assert features is not None
    observation = _observation(task, pose)
    start = spec.achieved_goal_start
    observation[start - 3 : start] = torch.from_numpy(angular)
    arguments = observation, torch.from_numpy(goal)
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
        seen = _rotated(angular, quaternion_conjugate(symmetry))
        np.testing.assert_allclose(
            _pose_inputs(task, turned, seen, turned_goal), before, atol=1e-12
        )
    other = pose.copy()
    other[3:] = quaternion_multiply(pose[3:], quaternion_from_axis_angle([1, 0.2, 0], 0.3))
    assert np.abs(_pose_inputs(task, other, angular, goal) - before).max() > 0.1


def test_all_rotations_of_a_cube_but_its_symmetries_differ() -> None:
    spec = task_spec('HandManipulateBlockRotateXYZ')
    start = spec.achieved_goal_start
    generator = np.random.default_rng(3)
    goal = np.array([0.0, 0, 0, 1, 0, 0, 0])
    poses = generator.normal(size=(200, 7))
    poses[:, :3] = 0.0
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    first = start - 3 + 3 + 3
    shapes = [
        _pose_inputs(spec.name, pose, np.zeros(3), goal)[first : first + 15] for pose in poses
    ]
    distances = np.linalg.norm(np.subtract.outer(shapes, shapes).diagonal(0, 1, 3), axis=-1)
    np.fill_diagonal(distances, np.inf)
    assert distances.min() > 0.02
    assert np.std(shapes, axis=0).min() > 0.2


def _rotated(vector: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    pure = np.concatenate([[0.0], vector])
    turned = quaternion_multiply(
        quaternion_multiply(quaternion, pure), quaternion_conjugate(quaternion)
    )
    return turned[1:]
