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


def pose(position=(0.0, 0.0, 0.0), quaternion=IDENTITY) -> np.ndarray:
    return np.concatenate([position, quaternion])


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


@pytest.mark.parametrize(
    ('task', 'near', 'far'),
    [
        ('FetchPush', [0.03, 0.0, 0.03], [0.0, 0.051, 0.0]),
        ('FetchPush', [0.05, 0.0, 0.0], [0.0501, 0.0, 0.0]),
        (
            'HandManipulateEggRotate',
            [0.5, 0.0, 0.0, *quaternion_from_axis_angle([0.0, 1.0, 0.0], 0.09)],
            pose(quaternion=quaternion_from_axis_angle([0.0, 1.0, 0.0], 0.11)),
        ),
    ],
)
def test_goals_count_within_the_threshold(task, near, far):
    goal = pose() if len(near) == 7 else np.zeros(3)
    for rule in ('gymnasium', 'paper'):
        assert metric(task, rule).reward([near, far], [goal, goal]).tolist() == [0.0, -1.0]
    if len(near) == 3:
        dense = metric(task, reward_type='dense').reward(near, goal)
        assert dense == pytest.approx(-np.linalg.norm(near))


def test_fingertips_by_the_norm_of_all_or_by_their_mean_distance():
    desired = np.zeros(15)
    achieved = np.tile([0.008, 0.0, 0.0], 5)
    # Norm over all coordinates 1.8 cm, mean distance 0.8 cm; the threshold is 1 cm.
    assert not metric('HandReach').success(achieved, desired)
    assert metric('HandReach', 'paper').success(achieved, desired)
    dense = metric('HandReach', 'paper', 'dense').reward(achieved, desired)
    assert dense == pytest.approx(-0.008)


@pytest.mark.parametrize('task', ['HandManipulateBlockFull', 'HandManipulateEggRotate'])
def test_opposite_quaternions_are_one_rotation_only_in_the_paper(task):
    quaternion = quaternion_from_axis_angle([1.0, 2.0, 3.0], 0.7)
    goals = pose(quaternion=quaternion), pose(quaternion=-quaternion)
    assert not metric(task).success(*goals)
    assert metric(task, reward_type='dense').reward(*goals) == pytest.approx(-2 * np.pi)
    assert metric(task, 'paper').success(*goals)


def test_rotate_tasks_ignore_the_position_and_full_tasks_do_not():
    far = pose((0.5, 0.0, 0.0))
    assert metric('HandManipulateBlockRotateXYZ').success(far, pose())
    assert not metric('HandManipulateBlockFull').success(far, pose())
    dense = metric('HandManipulateBlockFull', reward_type='dense').reward(far, pose())
    assert dense == pytest.approx(-5.0)


def test_the_pen_may_turn_about_its_axis_in_every_row_of_a_batch():
    # The reference takes the angles of the first rows instead of the last axis (pull request 338).
    tilt = quaternion_from_axis_angle([1.0, 0.0, 0.0], 0.4)
    spun = quaternion_multiply(tilt, quaternion_from_axis_angle([0.0, 0.0, 1.0], 1.3))
    achieved = np.stack([pose(quaternion=tilt), pose(quaternion=spun), pose()])
    desired = np.stack([pose(quaternion=tilt)] * 3)
    assert metric('HandManipulatePenRotate').success(achieved, desired).tolist()[0]
    single = [metric('HandManipulatePenRotate').success(a, desired[0]) for a in achieved]
    assert metric('HandManipulatePenRotate').success(achieved, desired).tolist() == single
    assert not single[2]


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
    for other in (
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


def test_settings_of_an_environment_keep_the_parameter():
    env = FetchHandEnv('FetchPush')
    env.simulation.metric = Scaled(env.simulation.spec, scale=0.5)
    env.distance_threshold = 0.2
    env.reward_type = 'dense'
    assert env.simulation.metric.scale == copy.deepcopy(env).simulation.metric.scale == 0.5
    assert env.distance_threshold == 0.2
