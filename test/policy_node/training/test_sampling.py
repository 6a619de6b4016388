"""Returns of several steps, chosen goals and conditions, on a chain whose values are known."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.tasks import task_spec
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Episodes
from policy_node.training.experience.sampling import TransitionSampler
from policy_node.training.machine import Workers
from policy_node.training.research.conditions import HorizonSampler, ThresholdSampler, fold
from policy_node.training.research.frequent_actions import HoldingSampler, length_of
from policy_node.training.research.judged import (
    SCORES,
    ChoosingSampler,
    CuttingSampler,
    LambdaSampler,
)
from policy_node.training.research.registry import make_ddpg, make_sampler

REAL = {'real': 1.0}
COUNT, TICKS, LONGEST = 5, 9, 4
ROW = np.tile(np.arange(COUNT), 80)
MIXTURE = {'future': 0.5, 'actual': 0.3, 'real': 0.2}
# Ticks of each episode that count, where not all do.
VALID = np.array([9, 3, 1, 6, 9])
HELD = np.random.default_rng(1).integers(1, LONGEST + 1, (COUNT, TICKS))


@pytest.fixture
def walk():
    """Twenty walks from place 0 to 6, a step each; the goal is place 4; actions are 1."""
    place = np.tile(np.arange(7, dtype=np.float32)[None, :, None], (20, 1, 1))
    goal = np.full((20, 1), 4.0, np.float32)
    return Episodes(place, place, goal, np.ones((20, 6, 1), np.float32))


def at_goal(achieved, goal):
    return (np.abs(achieved - goal).max(axis=-1) < 0.5) - 1.0


def draw(episodes, sampler, mixture=REAL):
    generator = np.random.default_rng(0)
    row = generator.integers(len(episodes), size=4_000)
    return sampler.sample(episodes, row, mixture, generator)


class Returning:
    """Acts as the walk does before place 3 and otherwise after."""

    def act(self, observation, goal):
        return np.where(observation < 3.0, 1.0, -1.0).astype(np.float32)


def test_lambda_draws_the_weights_of_the_lambda_return(walk):
    batch = draw(walk, LambdaSampler(at_goal, 0.5, 3, trace=0.6))
    start = batch.observation[:, 0] == 0.0
    steps = (batch.next_observation - batch.observation)[start, 0]
    shares = [float((steps == n).mean()) for n in (1, 2, 3)]
    assert shares == pytest.approx([0.4, 0.24, 0.36], abs=0.05)


def test_cut_ends_a_return_before_an_action_the_actor_would_not_take(walk):
    batch = draw(walk, CuttingSampler(at_goal, 0.5, 5, actor=Returning()))
    first, last = batch.observation[:, 0], batch.next_observation[:, 0]
    # At places 3 and up it would turn round; the first action of a return is always its own.
    expected = np.where(first < 3, 3, first + 1)
    assert (last == expected).all()


@pytest.mark.parametrize('wanted', [5.0, 6.0])
def test_the_best_of_several_future_goals_is_taken(
    walk: Episodes, wanted: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(SCORES, 'bellman', lambda _, batch: -np.abs(batch.goal[:, 0] - wanted))
    mixture = {'future': 0.5, 'real': 0.5}
    any_goal = draw(walk, TransitionSampler(at_goal, 0.9), mixture)
    batch = draw(walk, ChoosingSampler(at_goal, 0.9, choice='bellman', judge=Returning()), mixture)
    early = batch.observation[:, 0] == 0.0
    share = (batch.goal[early, 0] == wanted).mean()
    # One of eight uniform draws from six places is the best with 1 - (5/6)^8 = .77; half stay real.
    assert share == pytest.approx(0.5 * 0.77, abs=0.07)
    assert (any_goal.goal[early, 0] == wanted).mean() < 0.15
    assert (batch.goal[early, 0] == 4.0).mean() >= 0.45
    assert (batch.goal[:, 0] >= np.minimum(batch.observation[:, 0] + 1, 4.0)).all()


class Halved(GoalMetric):
    """A reward of its own, with a parameter that is no field."""

    def __init__(self, spec, scale=1.0, **others):
        super().__init__(spec, **others)
        object.__setattr__(self, 'scale', scale)

    def reward(self, achieved_goal, desired_goal, info=None):
        scale = self.__dict__['scale']
        return -scale * self.distances(achieved_goal, desired_goal)[0]


def test_hindsight_is_rewarded_by_a_metric_of_its_own_as_steps_are():
    metric = Halved(task_spec('FetchReach'), scale=0.5)
    goals = np.zeros((2, 3)), np.full((2, 3), 0.1)
    for change in ({}, {'first_distance': 4.0}):
        sampler = make_sampler(recipe_config('FetchReach', 'best', **change), metric)
        assert sampler.compute_reward(*goals).tobytes() == metric.reward(*goals).tobytes()


@pytest.mark.parametrize(
    ('change', 'line'),
    [
        ({'reward_grades': '.5,1,2'}, 'reward_grades .* would replace the reward of '),
        ({'condition': 'threshold'}, 'condition threshold would replace the reward of '),
    ],
)
def test_no_other_reward_takes_the_place_of_a_tasks_own(change, line):
    config = recipe_config('FetchReach', 'best', **change)
    with pytest.raises(ValueError, match=f'{line}FetchReach itself .Halved.; allowed: none'):
        make_sampler(config, Halved(task_spec('FetchReach')))
    make_sampler(config, GoalMetric(task_spec('FetchReach')))


def past_goal(achieved, goal):
    return (achieved > goal - 0.5)[:, 0] - 1.0


def test_values_count_the_rewards_of_the_steps_left(walk):
    torch.manual_seed(0)
    options = {'precision': 'float32', 'gamma': 0.5, 'learning_rate': 3e-3, 'target': 'none'}
    config = recipe_config('FetchReach', 'paper', condition='horizon', **options)
    learner = make_ddpg(NetworkShape(1, 1, 1, (32, 32)), config, torch.device('cpu'), Workers())
    sampler = HorizonSampler(past_goal, 0.5, ticks=3)
    generator = np.random.default_rng(0)
    # Actions have no effect on a walk, so the values of all actions are equal.
    walk.action[:] = generator.uniform(-1, 1, walk.action.shape)
    for _ in range(400):
        row = generator.integers(len(walk), size=64)
        learner.update(sampler.sample(walk, row, REAL, generator))
    found = {}
    for place in (0.0, 5.0):
        features = learner.actor.features(torch.full((3, 1), place), torch.full((3, 1), 4.0))
        inputs = torch.cat([features, torch.tensor([[1.0], [2.0], [3.0]]) / 3], dim=-1)
        with torch.no_grad():
            found[place] = learner.critic(inputs, torch.ones(3, 1)).tolist()
    assert found[0.0] == pytest.approx([-1.0, -1.5, -1.75], abs=0.15), 'of 1, 2 and 3 steps'
    assert found[5.0] == pytest.approx([0.0, 0.0, 0.0], abs=0.15)


def test_an_actor_at_one_condition_is_an_actor_like_any_other():
    options = {'precision': 'float32', 'condition': 'threshold'}
    config = recipe_config('FetchReach', 'paper', **options)
    learner = make_ddpg(NetworkShape(4, 3, 2, (16, 16)), config, torch.device('cpu'), Workers())
    plain = learner.acting_policy()
    assert isinstance(plain, Actor) and plain.network.hidden[0].in_features == 7
    features = torch.randn(5, 7)
    at_two = fold(learner.actor.network, plain.shape, 2.0)
    for folded, value in ((plain.network, 0.0), (at_two, 2.0)):
        wide = torch.cat([features, torch.full((5, 1), value)], dim=-1)
        torch.testing.assert_close(folded(features), learner.actor.network(wide))


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
        CuttingSampler(nearness, 0.9, 5, cut_distance=0.8, actor=Judge()),
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
