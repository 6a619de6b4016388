"""Subgoals: a high level whose actions are goals, and imagined ones as a prior on the actor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import from_flat, to_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Episodes, Transitions
from policy_node.training.learners.imagined import ImaginingDDPG
from policy_node.training.machine import Workers
from policy_node.training.research.hierarchy import (
    TESTED,
    GuidedPolicy,
    HierarchicalDDPG,
    Proposer,
    SubgoalSampler,
    with_subgoals,
)
from policy_node.training.research.registry import make_collector

CPU = torch.device('cpu')


def configured(**changes: object) -> TrainConfig:
    quick = {'precision': 'float32', 'target_update_interval': 1, 'polyak': 0.9, 'action_l2': 0.0}
    return recipe_config('FetchReach', 'best', **{**quick, 'subgoal_every': 10, **changes})


@torch.no_grad()
def test_the_high_level_proposes_and_learns_goals_on_the_same_scale() -> None:
    config = configured(actor_average=0.75, final_learning_rate=0.1)
    learner = HierarchicalDDPG(NetworkShape(1, 1, 1, (8,)), config, CPU, Workers())
    assert isinstance(learner.acting_policy(), Actor), 'no proposals before learning'
    assert learner.other_policies() == {}
    learner.updates = 1
    learner.actor.goal_normalizer.mean.fill_(2.0)
    learner.actor.goal_normalizer.std.fill_(0.5)
    for network, bias in ((learner.high.actor.network, 1.0), (learner.high.average_actor, 0.0)):
        network.output.weight.zero_()
        network.output.bias.fill_(bias)
    learner.average()
    zero = np.zeros((2, 1), np.float32)
    state = {'observation': zero, 'desired_goal': zero}
    (averaged,) = learner.other_policies().values()
    for policy, bias in ((learner.acting_policy(), 1.0), (averaged, 0.25)):
        assert isinstance(policy, GuidedPolicy)
        goals = policy.proposer.goals(policy.proposer.normalized(state))
        np.testing.assert_allclose(goals, 2.0 + 0.5 * 5.0 * np.tanh(bias), rtol=1e-5)
        batch = Transitions(zero, zero, zero, goals, zero[:, 0], zero[:, 0])
        np.testing.assert_allclose(learner.high.tensors(batch).action, np.tanh(bias), rtol=1e-5)
    learner.set_progress(1.0)
    rates = [optimizer.param_groups[0]['lr'] for optimizer in learner.optimizers.values()]
    assert rates == pytest.approx([0.1 * config.learning_rate] * 4)


class Constant:
    def __init__(self, value, size):
        self.value, self.size = value, size

    def predict(self, observation, state=None, *, deterministic=True):
        count = len(np.asarray(observation['observation']))
        return np.full((count, self.size), self.value, np.float32), None


def collected(proposer, noise, actor):
    simulation = Simulation('FetchReach', num_envs=80, num_threads=1)
    std, epsilon = noise
    config = from_flat(
        {'task': 'FetchReach'}, noise_std=std, random_epsilon=epsilon, subgoal_every=20
    )
    collector = make_collector(simulation, list(range(80)), config)
    policy = GuidedPolicy(actor, proposer, 20, 50) if proposer else actor
    return collector.collect(policy)[0]


def test_subgoals_hold_follow_the_action_and_are_tested_without_noise():
    torch.manual_seed(0)
    actor = Actor(NetworkShape(10, 3, 4, (8,))).eval()
    mean, std = np.full(3, 0.5, np.float32), np.full(3, 0.1, np.float32)
    proposer = Proposer(Constant(0.2, 3), mean, std, is_pose=False)
    episodes = collected(proposer, (0.2, 0.2), actor)
    assert episodes.action.shape == (80, 50, 4 + 3 + 1)
    subgoal, test = episodes.action[..., 4:7], episodes.action[..., 7]
    for start, end in ((0, 20), (20, 40), (40, 50)):
        for values in (subgoal, test):
            assert (values[:, start:end] == values[:, start : start + 1]).all()
    assert set(np.unique(test)) == {0.0, 1.0}
    assert test.mean() == pytest.approx(TESTED, abs=0.1)
    # Four fifths around .5 + 5 * .2 * .1 with .2 * .1; the others as goals are.
    noise = (subgoal[:, ::20] - 0.6) / 0.1
    assert np.median(noise) == pytest.approx(0.0, abs=0.1)
    assert (np.abs(noise) < 0.6).all(axis=-1).mean() == pytest.approx(0.83, abs=0.1)
    own, _ = actor.predict(
        {'observation': episodes.observation[:, 30], 'desired_goal': subgoal[:, 30]}
    )
    moved = np.abs(episodes.action[:, 30, :4] - own).max(axis=-1)
    assert (moved[test[:, 30] == 1.0] < 1e-5).all() and (moved[test[:, 30] == 0.0] > 1e-4).all()


def test_without_a_high_level_the_goal_itself_is_pursued():
    episodes = collected(None, (0.0, 0.0), Constant(0.0, 4))
    goal = np.repeat(episodes.desired_goal[:, None], 50, axis=1)
    np.testing.assert_array_equal(episodes.action[..., 4:7], goal)
    assert (episodes.action[..., 7] == 0.0).all()


def test_proposals_of_poses_end_with_unit_quaternions():
    mean, std = np.zeros(7, np.float32), np.arange(1.0, 8.0, dtype=np.float32)
    goals = Proposer(Constant(0.1, 7), mean, std, is_pose=True).goals(np.ones((2, 7), np.float32))
    np.testing.assert_allclose(goals[:, :3], [[1, 2, 3]] * 2)
    np.testing.assert_allclose(np.linalg.norm(goals[:, 3:], axis=1), 1.0, rtol=1e-6)


def test_both_levels_act_as_one_for_whole_episodes():
    asked = []

    class Counting(Constant):
        def predict(self, observation, *, deterministic=True):
            asked.append(float(observation['observation'][0, 0]))
            return super().predict(observation)

    one = np.ones(1, np.float32)
    high = Proposer(Counting(0.5, 1), one, one, is_pose=False)
    both = GuidedPolicy(Constant(0.7, 2), high, every=3, ticks=5)
    for tick in range(10):
        observation = {'observation': np.full((4, 1), tick), 'desired_goal': np.zeros((4, 1))}
        assert (both.predict(observation)[0] == np.float32(0.7)).all()
    assert asked == [0, 3, 5, 8]


def walk(subgoal, tested):
    """To the right by one a tick, the subgoal the same throughout."""
    place = np.arange(7, dtype=np.float32)[None, :, None]
    action = np.tile(np.array([1.0, subgoal, tested], np.float32), (1, 6, 1))
    return Episodes(place, place, np.full((1, 1), 5.0, np.float32), action)


@pytest.mark.parametrize(
    ('subgoal', 'tested', 'missed'), [(9.0, 1.0, True), (9.0, 0.0, False), (3.0, 1.0, False)]
)
def test_what_was_achieved_was_proposed_unless_a_test_was_missed(subgoal, tested, missed):
    """Three ticks lead three places on; rewards are known, and so is what a test costs.

    The second proposal of 3 is missed, at 6.
    """
    sampler = SubgoalSampler(
        compute_reward=lambda a, g: -1.0 * (a != g)[..., 0],
        gamma=0.5,
        most_steps=3,
        missed_value=-2.0,
    )
    row = np.zeros(300, np.int64)
    episodes = walk(subgoal, tested)
    mixture = {'future': 0.5, 'real': 0.5}
    batch = sampler.sample(episodes, row, mixture, np.random.default_rng(0))
    tick = batch.observation[:, 0].astype(int)
    assert set(tick) == {0, 1, 2, 3}
    penalty = (tick % 3 == 0) & missed
    if subgoal == 3.0:
        penalty = tick == 3
    np.testing.assert_array_equal(batch.next_observation[:, 0], tick + 3)
    np.testing.assert_array_equal(batch.action[:, 0], np.where(penalty, subgoal, tick + 3))
    np.testing.assert_allclose(batch.discount, np.where(penalty, 0.0, 0.125))
    goals = batch.goal[:, 0]
    assert set(goals) == {1.0, 2.0, 3.0, 4.0, 5.0, 6.0}
    summed = [
        -sum(0.5**i * (t + i + 1 != goal) for i in range(3))
        for t, goal in zip(tick, goals, strict=True)
    ]
    np.testing.assert_allclose(batch.reward, np.where(penalty, -2.0, summed))


def test_half_of_the_goals_that_are_kept_are_subgoals():
    assert with_subgoals({'future': 0.8, 'real': 0.2}) == {
        'future': 0.8,
        'real': 0.1,
        'subgoal': 0.1,
    }
    assert with_subgoals({'future': 1.0}) == {'future': 1.0}


SHAPE = NetworkShape(10, 3, 4, (64, 64))


def imagining(**changes):
    quick = {'precision': 'float32', 'action_l2': 0.0, 'goal_features': 'plain'}
    return recipe_config('FetchReach', 'best', **{**quick, 'subgoal_prior': 1.0, **changes})


class Distance(torch.nn.Module):
    """The true value: minus the ticks to the goal, `per_unit` for each unit of distance."""

    def __init__(self, per_unit):
        super().__init__()
        self.per_unit = per_unit
        self.unused = torch.nn.Parameter(torch.zeros(()))

    def forward(self, features, action):
        distance = (features[:, :3] - features[:, -3:]).norm(dim=-1)
        return -self.per_unit * distance + self.unused + 0.0 * action.sum(dim=-1)


def learner_of(**changes):
    """Return a learner whose critic has the true values."""
    torch.manual_seed(0)
    learner = ImaginingDDPG(SHAPE, imagining(**changes), torch.device('cpu'), Workers())
    learner.critic = learner.target_critic = Distance(20.0)
    learner.critic_parameters = [learner.critic.unused]
    learner.critic_optimizer = torch.optim.Adam(learner.critic_parameters, lr=0.0)
    return learner


def on_a_line(generator, count):
    """States and goals anywhere from -1 to 1 along the first axis."""
    state, goal = np.zeros((count, 10), np.float32), np.zeros((count, 3), np.float32)
    state[:, 0], goal[:, 0] = generator.uniform(-1, 1, (2, count))
    nothing = np.zeros(count, np.float32)
    return Transitions(state, state, goal, np.zeros((count, 4), np.float32), nothing, nothing)


@pytest.mark.release
def test_what_is_imagined_lies_halfway_by_value():
    learner, generator = learner_of(learning_rate=3e-3), np.random.default_rng(0)
    for _ in range(400):
        learner.update(on_a_line(generator, 512))
    batch = on_a_line(generator, 500)
    inputs = torch.from_numpy(batch.observation), torch.from_numpy(batch.goal)
    with torch.no_grad():
        imagined = learner.imagine(learner.actor.features(*inputs)).numpy()
    middle = (batch.observation[:, 0] + batch.goal[:, 0]) / 2
    assert np.abs(imagined[:, 0] - middle).mean() < 0.1
    assert np.abs(imagined[:, 1:]).max() < 0.1


def test_the_actor_is_drawn_to_what_it_does_for_the_subgoal():
    """Values here say nothing of actions, so the prior alone moves the actor."""
    learner, generator = learner_of(subgoal_prior=5.0), np.random.default_rng(0)
    batch = on_a_line(generator, 64)
    known = learner.tensors(batch)

    def distance():
        with torch.no_grad():
            subgoal = learner.imagine(known.features)
            prior = learner.actor.act(batch.observation, subgoal.numpy())
            own = learner.actor.act(batch.observation, batch.goal)
            penalty = learner._penalty(known, learner.actor(known.features))
        assert float(penalty) == pytest.approx(5.0 * np.square(own - prior).mean(), rel=1e-4)
        return float(penalty)

    # Until the copy moves for the first time it is the actor as it was.
    before = distance()
    learner.config = imagining(subgoal_prior=5.0, target_update_interval=1, polyak=0.0)
    for _ in range(200):
        learner.update(batch)
    assert distance() < 0.1 * before


def test_the_network_that_imagines_learns_at_its_interval():
    changes = {'subgoal_prior': 0.3, 'imagination_interval': 3}
    learner, batch = learner_of(**changes), on_a_line(np.random.default_rng(0), 64)
    learnt = []
    for _ in range(7):
        before = [value.clone() for value in learner.imagination.parameters()]
        learner.update(batch)
        now = list(learner.imagination.parameters())
        learnt.append(not all(torch.equal(*pair) for pair in zip(before, now, strict=True)))
    assert learnt == [True, False, False, True, False, False, True]


@pytest.mark.parametrize(
    ('task', 'changes', 'prior'),
    [
        ('FetchPickAndPlace', {}, 0.3),
        ('FetchPickAndPlace', {'subgoal_prior': 0.0}, 0.0),
        ('FetchPickAndPlace', {'condition': 'threshold'}, 0.0),
        ('FetchPush', {}, 0.0),
    ],
)
def test_best_imagines_where_it_pays_and_nothing_else_is_asked_for(task, changes, prior):
    assert to_flat(recipe_config(task, 'best', **changes))['subgoal_prior'] == prior
