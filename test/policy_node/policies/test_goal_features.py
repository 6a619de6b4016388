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
from policy_node.policies.goal_features import relative_goal

POSE_TASKS = [name for name, spec in TASKS.items() if spec.goal is GoalKind.POSE]


def _observation(task: str, achieved: np.ndarray) -> torch.Tensor:
    spec = task_spec(task)
    observation = np.random.default_rng(1).normal(size=spec.observation_size)
    start = spec.achieved_goal_start
    observation[start : start + spec.goal.size] = achieved
    return torch.from_numpy(observation)


@pytest.mark.parametrize('task', list(TASKS))
def test_the_achieved_goal_is_where_the_specification_says(task: str) -> None:
    from fetch_hand_sim.simulation import Simulation

    simulation = Simulation(task, num_envs=2)
    observation = simulation.reset(seed=3)
    spec = simulation.spec
    part = slice(spec.achieved_goal_start, spec.achieved_goal_start + spec.goal.size)
    assert (observation['observation'][:, part] == observation['achieved_goal']).all()


@pytest.mark.parametrize('task', list(TASKS))
def test_sizes(task: str) -> None:
    spec = task_spec(task)
    features = relative_goal(spec)
    values = features(torch.zeros(4, 2, spec.observation_size), torch.zeros(4, 2, spec.goal.size))
    assert values.shape == (4, 2, features.size)


def test_rotation_is_goal_times_conjugate_with_its_sign() -> None:
    generator = np.random.default_rng(0)
    achieved = np.concatenate([np.zeros(3), quaternion_from_axis_angle([1, 2, 3], 0.4)])
    for sign in (1.0, -1.0):
        quaternion = sign * quaternion_from_axis_angle(generator.normal(size=3), 2.0)
        goal = np.concatenate([np.zeros(3), quaternion])
        observation = _observation('HandManipulateBlockFull', achieved)
        features = relative_goal(task_spec('HandManipulateBlockFull'))
        values = features(observation, torch.from_numpy(goal)).numpy()
        expected = quaternion_multiply(quaternion, quaternion_conjugate(achieved[3:]))
        np.testing.assert_allclose(values[:4], expected, atol=1e-12)
        np.testing.assert_allclose(values[4:7], np.clip(10 * expected[1:], -5, 5), atol=1e-12)


def test_position_counts_only_where_the_task_says_so() -> None:
    achieved, goal = np.zeros(7), np.array([0.01, -0.02, 0.5, 1.0, 0.0, 0.0, 0.0])
    achieved[3] = 1.0
    for task in POSE_TASKS:
        values = relative_goal(task_spec(task))(
            _observation(task, achieved), torch.from_numpy(goal)
        )
        wanted = [0.5, -1.0, 5.0] if task.endswith('Full') else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(values[7:], wanted, atol=1e-12)


def test_turning_the_pen_about_its_own_axis_changes_nothing() -> None:
    features = relative_goal(task_spec('HandManipulatePenFull'))
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
    features = relative_goal(task_spec('FetchSlide'))
    observation = _observation('FetchSlide', np.array([1.0, 0.5, 0.4]))
    values = features(observation, torch.tensor([1.6, 0.49, 0.4], dtype=torch.float64))
    np.testing.assert_allclose(values, [0.6, -0.01, 0, 5.0, -0.1, 0], atol=1e-12)
