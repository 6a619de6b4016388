"""Returns of several steps, chosen goals and conditions, on a chain whose values are known."""

from __future__ import annotations

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
from policy_node.training.research.conditions import HorizonSampler, fold
from policy_node.training.research.judged import (
    SCORES,
    ChoosingSampler,
    CuttingSampler,
    LambdaSampler,
)
from policy_node.training.research.registry import make_ddpg, make_sampler

TICKS = 6
REAL = {'real': 1.0}


@pytest.fixture
def walk():
    """Twenty walks from place 0 to 6, a step each; the goal is place 4; actions are 1."""
    place = np.tile(np.arange(TICKS + 1, dtype=np.float32)[None, :, None], (20, 1, 1))
    goal = np.full((20, 1), 4.0, np.float32)
    return Episodes(place, place, goal, np.ones((20, TICKS, 1), np.float32))


def at_goal(achieved, goal):
    return (np.abs(achieved - goal).max(axis=-1) < 0.5) - 1.0


def draw(episodes, sampler, mixture=REAL):
    generator = np.random.default_rng(0)
    row = generator.integers(len(episodes), size=4_000)
    return sampler.sample(episodes, row, mixture, generator)


class Judge:
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
    batch = draw(walk, CuttingSampler(at_goal, 0.5, 5, judge=Judge()))
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
    batch = draw(walk, ChoosingSampler(at_goal, 0.9, choice='bellman', judge=Judge()), mixture)
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
        (
            {'reward_grades': '.5,1,2'},
            'reward_grades .* would replace the reward of ',
        ),
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
    observation, goal = np.random.default_rng(0).normal(size=(2, 5, 4))[0], np.ones((5, 3))
    action, _ = plain.predict({'observation': observation, 'desired_goal': goal})
    own = learner.act(observation.astype(np.float32), goal.astype(np.float32))
    np.testing.assert_allclose(action, own, atol=1e-6)
    folded = fold(learner.actor.network, plain.shape, 2.0)
    features = torch.randn(5, 7)
    wide = torch.cat([features, torch.full((5, 1), 2.0)], dim=-1)
    torch.testing.assert_close(folded(features), learner.actor.network(wide))
