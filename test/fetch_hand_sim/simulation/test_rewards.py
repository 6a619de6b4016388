"""Rewards and success rules, recomputed for goals of any shape."""

from __future__ import annotations

import copy
import pickle
from dataclasses import dataclass, replace

import numpy as np
import pytest

from fetch_hand_sim.gym_envs.env import FetchHandEnv
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.rotations import quaternion_from_axis_angle, quaternion_multiply
from msgs_spec.tasks import TASKS, GoalKind

IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def random_goals(spec, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Goals (count, goal size), near enough for some to be reached."""
    generator = np.random.default_rng(0)
    achieved = generator.normal(size=(count, spec.goal.size))
    scale = spec.distance_threshold * np.geomspace(0.05, 20.0, count)[:, None]
    desired = achieved + scale * generator.normal(size=achieved.shape)
    if spec.goal is GoalKind.POSE:
        for goals in (achieved, desired):
            goals[:, 3:] /= np.linalg.norm(goals[:, 3:], axis=1, keepdims=True)
    return achieved, desired


def metric(task: str, success_rule='gymnasium', reward_type='sparse'):
    return GoalMetric(TASKS[task], success_rule, reward_type)


def turned(angle: float, about=(0.0, 1.0, 0.0)) -> np.ndarray:
    return quaternion_from_axis_angle(about, angle)


def pose(x: float = 0.0, quaternion=IDENTITY) -> np.ndarray:
    return np.array([x, 0.0, 0.0, *quaternion])


@pytest.mark.parametrize('success_rule', ['gymnasium', 'paper'])
@pytest.mark.parametrize('reward_type', ['sparse', 'dense'])
@pytest.mark.parametrize('task', TASKS)
def test_any_batch_equals_the_single_call_bit_for_bit(task, reward_type, success_rule):
    measure = metric(task, success_rule, reward_type)
    achieved, desired = random_goals(TASKS[task], 60)
    single = np.array([measure.reward(*goals) for goals in zip(achieved, desired, strict=True)])
    if reward_type == 'sparse':
        assert set(single) == {-1.0, 0.0}, 'the goals must be a mixture of reached and not'
    shapes = {
        'batch': (achieved, desired),
        'two axes': (achieved.reshape(3, 20, -1), desired.reshape(3, 20, -1)),
        'column major': (np.asfortranarray(achieved), np.asfortranarray(desired)),
        'mixed layout': (achieved, np.asfortranarray(desired)),
        'strided': (np.repeat(achieved, 2, axis=0)[::2], np.repeat(desired, 2, axis=1)[:, ::2]),
        'lists': (achieved.tolist(), desired.tolist()),
    }
    for name, goals in shapes.items():
        assert measure.reward(*goals, [{}] * 60).tobytes() == single.tobytes(), name
    reversed_rows = measure.reward(achieved[::-1], desired[::-1])
    assert reversed_rows[::-1].tobytes() == single.tobytes()
    assert measure.evaluate(achieved, desired)[0].tobytes() == single.tobytes()
    narrow = [goals.astype(np.float32) for goals in (achieved, desired)]
    wide = [goals.astype(np.float64) for goals in narrow]
    assert measure.reward(*narrow).tobytes() == measure.reward(*wide).tobytes()
    assert measure.reward(achieved[:0], desired[:0]).shape == (0,)
    unknown = np.full_like(desired, np.nan)
    assert not measure.success(achieved, unknown).any()
    if reward_type == 'sparse':
        assert (measure.reward(achieved, unknown) == -1.0).all()


TURNED = turned(0.7, about=(1.0, 2.0, 3.0))
TILTED = turned(0.4, about=(1.0, 0.0, 0.0))


@pytest.mark.parametrize(
    ('task', 'achieved', 'desired', 'dense', 'successes'),
    [
        ('FetchPush', [0.03, 0.0, 0.03], np.zeros(3), -0.03 * np.sqrt(2.0), (True, True)),
        ('FetchPush', [0.0, 0.0501, 0.0], np.zeros(3), -0.0501, (False, False)),
        # Norm over all coordinates 1.8 cm, mean distance 0.8 cm; the threshold is 1 cm.
        ('HandReach', [0.008, 0.0, 0.0] * 5, np.zeros(15), -0.008 * np.sqrt(5.0), (False, True)),
        ('HandManipulateEggRotate', pose(0.5, turned(0.09)), pose(), -0.09, (True, True)),
        ('HandManipulateEggRotate', pose(0.0, turned(0.11)), pose(), -0.11, (False, False)),
        ('HandManipulateBlockFull', pose(0.5), pose(), -5.0, (False, False)),
        # Opposite quaternions are one rotation only in the paper.
        ('HandManipulateBlockFull', pose(0, TURNED), pose(0, -TURNED), -2 * np.pi, (False, True)),
        # The pen may turn about its axis.
        (
            'HandManipulatePenRotate',
            pose(0.0, quaternion_multiply(TILTED, turned(1.3, about=(0.0, 0.0, 1.0)))),
            pose(0.0, TILTED),
            0.0,
            (True, True),
        ),
        ('HandManipulatePenRotate', pose(), pose(0.0, TILTED), -0.4, (False, False)),
    ],
)
def test_distances_and_thresholds_of_both_success_rules(task, achieved, desired, dense, successes):
    for rule, is_success in zip(('gymnasium', 'paper'), successes, strict=True):
        assert metric(task, rule).success(achieved, desired) == is_success
        assert metric(task, rule).reward(achieved, desired) == is_success - 1.0
    measured = metric(task, reward_type='dense').reward(achieved, desired)
    assert measured == pytest.approx(dense, abs=1e-6)


def test_at_the_threshold_the_reward_is_0_without_a_success():
    goals, measure = ([0.05, 0.0, 0.0], np.zeros(3)), metric('FetchPush')
    assert (measure.reward(*goals), measure.success(*goals)) == (0.0, False)


@pytest.mark.parametrize('name', ['reward', 'success'])
def test_a_metric_of_a_task_is_used_in_steps_too(name):
    def other(self, achieved_goal, desired_goal, info=None):
        return self.distances(achieved_goal, desired_goal)[0] > 0.01

    mine = type('Mine', (GoalMetric,), {name: other})(TASKS['FetchPush'])
    goals = random_goals(TASKS['FetchPush'], 20)
    reward, success = mine.evaluate(*goals)
    assert np.array_equal(reward, mine.reward(*goals))
    assert np.array_equal(success, mine.success(*goals))
    with_it = {'reward': reward, 'success': success}[name]
    assert np.array_equal(with_it, other(mine, *goals))


class Scaled(GoalMetric):
    """With a parameter that `__init__` sets."""

    def __init__(self, spec, scale=1.0, **others):
        super().__init__(spec, **others)
        self.scale = scale

    def reward(self, achieved_goal, desired_goal, info=None):
        return -self.scale * self.distances(achieved_goal, desired_goal)[0]


@dataclass(frozen=True, slots=True)
class ScaledSlot(GoalMetric):
    """With a parameter that is a field, without a dictionary of its own."""

    scale: float = 1.0
    reward = Scaled.reward


@pytest.mark.parametrize('kind', [Scaled, ScaledSlot])
def test_a_parameter_of_a_metric_of_its_own_outlives_changes_copies_and_pickles(kind):
    spec = TASKS['FetchPush']
    mine = kind(spec, scale=0.5)
    goals = random_goals(spec, 5)
    wider = replace(spec, distance_threshold=0.1)
    env = FetchHandEnv('FetchPush')
    env.simulation.metric = mine
    env.distance_threshold, env.reward_type = 0.2, 'dense'
    assert env.distance_threshold == 0.2
    for other in (
        env.simulation.metric,
        copy.deepcopy(env).simulation.metric,
        mine.with_changes(spec=wider, reward_type='dense', success_rule='paper'),
        copy.copy(mine),
        copy.deepcopy(mine),
        pickle.loads(pickle.dumps(mine)),
    ):
        assert other.scale == 0.5
        assert other.reward(*goals).tobytes() == mine.reward(*goals).tobytes()
    changed = mine.with_changes(spec=wider)
    assert (changed.spec, mine.spec) == (wider, spec)
    with pytest.raises(ValueError, match="reward_type 'denser'"):
        mine.with_changes(reward_type='denser')
