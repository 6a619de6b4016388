"""Rewards of several steps for goals that differ from row to row, against a loop over the steps."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.research.conditions import ThresholdSampler
from policy_node.training.research.frequent_actions import HoldingSampler, length_of
from policy_node.training.research.hierarchy import SubgoalSampler
from policy_node.training.research.judged import CuttingSampler, LambdaSampler

COUNT, TICKS, LONGEST = 5, 9, 4
ROW = np.tile(np.arange(COUNT), 80)
MIXTURE = {'future': 0.5, 'actual': 0.3, 'real': 0.2}
# Ticks of each episode that count, where not all do.
VALID = np.array([9, 3, 1, 6, 9])
HELD = np.random.default_rng(1).integers(1, LONGEST + 1, (COUNT, TICKS))


@pytest.fixture
def episodes():
    """Random walks of some centimetres a tick; what is observed are the episode and the tick."""
    generator = np.random.default_rng(0)
    row, tick = np.meshgrid(np.arange(COUNT), np.arange(TICKS + 1), indexing='ij')
    place = 0.03 * generator.normal(size=(COUNT, TICKS + 1, 3)).cumsum(axis=1)
    goal = 0.05 * generator.normal(size=(COUNT, 3))
    # As a subgoal it would be three numbers and whether it is tested: here never.
    action = np.zeros((COUNT, TICKS, 5))
    action[..., 4] = length_of(HELD, LONGEST)
    arrays = np.stack([row, tick], axis=-1), place, goal, action
    return Episodes(*(values.astype(np.float32) for values in arrays))


def nearness(achieved, goal):
    """A reward that no two places and no two goals share."""
    return -np.linalg.norm(achieved - goal, axis=-1)


def steps_of(batch):
    return (batch.next_observation - batch.observation)[:, 1].astype(int)


def assert_rewards_are_those_of_a_loop(episodes, batch, reward_of):
    """Compare with a loop: each step is rewarded for the goal of its row, discounted by 0.9."""
    expected = []
    for index, steps in enumerate(steps_of(batch)):
        row, tick = batch.observation[index].astype(int)
        goal = batch.goal[index].astype(float)
        following = episodes.achieved_goal[row, tick + 1 : tick + steps + 1].astype(float)
        rewards = [reward_of(index, achieved, goal) for achieved in following]
        expected.append(sum(0.9**step * reward for step, reward in enumerate(rewards)))
    np.testing.assert_allclose(batch.reward, expected, rtol=1e-5)
    np.testing.assert_allclose(batch.discount, 0.9 ** steps_of(batch), rtol=1e-6)
    np.testing.assert_array_equal(batch.observation[:, 0], batch.next_observation[:, 0])
    assert len(np.unique(batch.goal, axis=0)) > 20, 'goals differ from row to row'


class Judge:
    """Would do what was done in every other episode, and the opposite in the others."""

    def act(self, observation, goal):
        return np.repeat(observation[:, :1] % 2, 5, axis=1)


@pytest.mark.parametrize('valid', [None, VALID], ids=['all', 'valid'])
@pytest.mark.parametrize(
    'sampler',
    [
        TransitionSampler(nearness, 0.9),
        TransitionSampler(nearness, 0.9, 2),
        TransitionSampler(nearness, 0.9, 5),
        TransitionSampler(nearness, 0.9, 100),
        LambdaSampler(nearness, 0.9, 5, trace=0.6),
        CuttingSampler(nearness, 0.9, 5, cut_distance=0.8, judge=Judge()),
        HoldingSampler(nearness, 0.9, LONGEST),
    ],
    ids=['1', '2', '5', '100', 'lambda', 'cut', 'held'],
)
def test_every_step_of_a_return_is_rewarded_for_the_goal_of_its_row(episodes, sampler, valid):
    generator = np.random.default_rng(2)
    batch = sampler.sample(episodes, ROW, MIXTURE, generator, valid)
    assert_rewards_are_those_of_a_loop(episodes, batch, lambda _, *goals: nearness(*goals))
    tick, steps = batch.observation[:, 1].astype(int), steps_of(batch)
    np.testing.assert_array_equal(batch.action, episodes.action[ROW, tick])
    left = (TICKS if valid is None else valid[ROW]) - tick
    assert (steps >= 1).all() and (steps <= left).all()
    assert len(set(steps)) > 1 or sampler.most_steps == 1
    assert (batch.observation[:, 0] == ROW).all()
    assert {getattr(batch, each.name).dtype for each in fields(batch)} == {np.dtype(np.float32)}
    if isinstance(sampler, HoldingSampler):
        np.testing.assert_array_equal(steps, np.minimum(HELD[ROW, tick], left))
    elif type(sampler) is TransitionSampler:
        np.testing.assert_array_equal(steps, np.minimum(sampler.most_steps, left))


@pytest.mark.parametrize('n_step', [1, 3])
def test_a_reward_for_a_share_of_time_is_that_share_at_every_step(episodes, n_step):
    sampler = TransitionSampler(nearness, 0.9, n_step, reward_scale=0.1)
    batch = sampler.sample(episodes, ROW, MIXTURE, np.random.default_rng(2))
    assert_rewards_are_those_of_a_loop(episodes, batch, lambda _, *goals: 0.1 * nearness(*goals))


@pytest.mark.parametrize('every', [2, 4, TICKS])
def test_every_tick_of_a_subgoal_is_rewarded_for_the_goal_of_its_row(
    episodes: Episodes, every: int
) -> None:
    sampler = SubgoalSampler(
        compute_reward=nearness, gamma=0.9, most_steps=every, missed_value=-50.0
    )
    episodes.action[..., 4] = 0.0
    batch = sampler.sample(episodes, ROW, MIXTURE, np.random.default_rng(2))
    assert set(steps_of(batch)) == {every}
    assert_rewards_are_those_of_a_loop(episodes, batch, lambda _, *goals: nearness(*goals))


@pytest.mark.parametrize('n_step', [1, 3, 100])
def test_the_threshold_of_a_row_holds_at_every_step_of_its_return(episodes, n_step):
    spec = task_spec('FetchReach')
    sampler = ThresholdSampler(nearness, 0.9, n_step, metric=GoalMetric(spec), widest=4.0)
    batch = sampler.sample(episodes, ROW, MIXTURE, np.random.default_rng(2))
    near = spec.distance_threshold * np.exp(batch.condition[:, 0].astype(float))
    assert 0.02 < near.min() < 0.03 and 0.15 < near.max() < 0.2
    assert np.median(near) == pytest.approx(0.05 * 2**0.5, abs=0.01), 'log-uniform'

    def met(index, achieved, goal):
        return float(np.linalg.norm(achieved - goal) < near[index]) - 1.0

    assert_rewards_are_those_of_a_loop(episodes, batch, met)
    np.testing.assert_array_equal(batch.next_condition, batch.condition)
    assert n_step == 1 or len(set(batch.reward)) > 4, 'met at some steps and missed at others'
