"""Imagined subgoals as a prior on the actor, on a line whose values are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.flat import to_flat
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.imagined import ImaginingDDPG
from policy_node.training.machine import Workers

SHAPE = NetworkShape(10, 3, 4, (64, 64))


def configured(**changes):
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
    learner = ImaginingDDPG(SHAPE, configured(**changes), torch.device('cpu'), Workers())
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
            prior = learner.act(batch.observation, subgoal.numpy())
            own = learner.act(batch.observation, batch.goal)
            penalty = learner._penalty(known, learner.actor(known.features))
        assert float(penalty) == pytest.approx(5.0 * np.square(own - prior).mean(), rel=1e-4)
        return float(penalty)

    # Until the copy moves for the first time it is the actor as it was.
    before = distance()
    learner.config = configured(subgoal_prior=5.0, target_update_interval=1, polyak=0.0)
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
