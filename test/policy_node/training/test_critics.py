"""Ensembles, their normalisation and their common targets, on problems with a known answer."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import Critics
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.research.critics import (
    Ensemble,
    critic_loss,
    quantile_costs,
    sample_of,
)
from policy_node.training.research.judged import bellman, uncertain
from support.learners import SHAPE, make_learner


def test_members_start_differently_and_have_an_axis_of_their_own() -> None:
    critic = critic_loss(Critics(critics=5)).make(3 - SHAPE.action_size, SHAPE)
    assert isinstance(critic, Ensemble)
    values = critic(torch.randn(7, 2), torch.randn(7, 1))
    assert values.shape == (5, 7) and len(set(values[:, 0].tolist())) == 5


def chain_batch(count: int, generator: np.random.Generator) -> Transitions:
    """A chain of states 0 ... 3, always a step to the right; the goal is state 3, the last."""
    state = generator.integers(4, size=count)
    after = np.minimum(state + 1, 3)
    return Transitions(
        observation=state.astype(np.float32)[:, None],
        next_observation=after.astype(np.float32)[:, None],
        goal=np.full((count, 1), 3.0, np.float32),
        action=generator.uniform(-1, 1, (count, 1)).astype(np.float32),
        reward=(after == 3).astype(np.float32) - 1.0,
        discount=np.full(count, 0.5, np.float32),
    )


@pytest.mark.parametrize(
    'changes',
    [
        {'target': 'none', 'norm': 'batch'},
        {'critics': 3, 'aggregate': 'min', 'target_update_interval': 5},
        {'critics': 2, 'aggregate': 'truncated', 'norm': 'layer', 'target': 'none'},
        {'critics': 2, 'quantiles': 5, 'aggregate': 'truncated', 'target_update_interval': 5},
    ],
    ids=str,
)
def test_values_of_a_chain_are_its_discounted_rewards(changes: dict[str, object]) -> None:
    learner = make_learner(**changes)
    generator = np.random.default_rng(0)
    state = torch.arange(4.0)[:, None]
    features = learner.actor.features(state, torch.full((4, 1), 3.0))
    is_batch_norm = changes.get('norm') == 'batch'
    seen, updates = [], 600 if is_batch_norm else 300
    for update in range(updates):
        learner.update(chain_batch(64, generator))
        if update >= updates // 2:
            with torch.no_grad():
                values = learner.critic(features, torch.zeros(4, 1))
            seen.append((values if values.ndim == 1 else values.mean(dim=0)).numpy())
    # The average: without target networks batch normalisation keeps them moving by 0.2.
    atol = 0.2 if is_batch_norm else 0.15
    np.testing.assert_allclose(np.mean(seen, axis=0), [-1.5, -1.0, 0.0, 0.0], atol=atol)


# Of observation, goal and action: what the critics are, and what their slow copies are.
CRITICS = np.array([[0.5, -0.3, 0.2, -0.4], [-0.4, 0.1, 0.6, -1.1], [0.2, 0.8, -0.7, -0.9]])
SLOW = np.array([[0.8, 0.5, -0.6, -1.2], [0.9, -0.5, 0.4, -1.0], [-0.8, 0.6, 0.1, -0.4]])
SLOW_ACTOR = np.array([0.7, -0.4, 0.1])


def linear_learner(critics: int, **changes: object) -> DDPG:
    """The first of these critics, each a weighted sum; the actor differs from its slow copy."""
    learner = make_learner(NetworkShape(1, 1, 1, (1,)), critics=critics, **changes)
    make_linear(learner.target_actor, SLOW_ACTOR)
    for ensemble, weights in ((learner.critic, CRITICS), (learner.target_critic, SLOW)):
        members = [ensemble] if critics == 1 else ensemble.members
        for member, own in zip(members, weights, strict=False):
            make_linear(member.network, own)
    return learner


@torch.no_grad()
def make_linear(network: MLP, weights: np.ndarray) -> None:
    """Make the output the weighted sum of the inputs plus a bias: the hidden unit stays above 0."""
    network.hidden[0].weight.copy_(torch.tensor(weights[None, :-1]))
    network.hidden[0].bias.fill_(20.0)
    network.output.weight.fill_(1.0)
    network.output.bias.fill_(weights[-1] - 20.0)


def scattered(count: int = 200) -> Transitions:
    generator = np.random.default_rng(0)
    columns = generator.uniform(-2, 2, (3, count, 1)).astype(np.float32)
    action = generator.uniform(-1, 1, (count, 1)).astype(np.float32)
    reward = -generator.integers(0, 2, count).astype(np.float32)
    # Returns differ in length, so discounts do.
    discount = generator.choice([0.5, 0.25], count).astype(np.float32)
    return Transitions(*columns, action, reward, discount)


def said(weights: np.ndarray, *inputs: np.ndarray) -> np.ndarray:
    return np.concatenate(inputs, axis=1) @ weights[:-1] + weights[-1]


def values_by_hand(critics: int, batch: Transitions) -> tuple[np.ndarray, np.ndarray]:
    """Values, and slow ones of the next states, each (critics, batch)."""
    now = batch.observation, batch.goal, batch.action
    action = np.tanh(said(SLOW_ACTOR, batch.next_observation, batch.goal))[:, None]
    then = batch.next_observation, batch.goal, action
    return tuple(
        np.stack([said(own, *seen) for own in weights[:critics]])
        for weights, seen in ((CRITICS, now), (SLOW, then))
    )


def test_surprise_is_how_far_a_value_is_from_its_clipped_target() -> None:
    batch = scattered()
    value, following = values_by_hand(1, batch)
    target = np.clip(batch.reward + batch.discount * following[0], -2.0, 0.0)
    assert (target == -2.0).any() and (target == 0.0).any(), 'both limits matter'
    found = bellman(linear_learner(1), batch)
    np.testing.assert_allclose(found, np.abs(value[0] - target), atol=1e-5)


def test_disagreement_is_the_deviation_of_values_over_critics() -> None:
    batch = scattered()
    value, _ = values_by_hand(3, batch)
    found = uncertain(linear_learner(3), batch)
    np.testing.assert_allclose(found, value.std(axis=0, ddof=1), atol=1e-5)


@pytest.mark.parametrize('aggregate', ['mean', 'min', 'truncated'])
def test_all_critics_learn_from_one_target_of_their_copies(aggregate: str) -> None:
    batch, learner = scattered(), linear_learner(3, aggregate=aggregate)
    value, following = values_by_hand(3, batch)
    assert set(following.argmin(axis=0)) == set(following.argmax(axis=0)) == {0, 1, 2}
    low, middle, high = np.sort(following, axis=0)
    together = {'mean': (low + middle + high) / 3, 'min': low, 'truncated': (low + middle) / 2}
    target = np.clip(batch.reward + batch.discount * together[aggregate], -2.0, 0.0)
    known = learner.tensors(batch)
    with torch.no_grad():
        found = learner.targets(known.reward, known.discount, known.next_features)
    np.testing.assert_allclose(found, target, atol=1e-5)
    loss = learner.update(batch).critic
    assert loss.item() == pytest.approx(np.square(value - target).mean(), rel=1e-4)


def test_a_batch_norm_sees_states_and_next_states_together() -> None:
    """CrossQ: statistics of one pass over both, and none of any other pass."""
    shape = NetworkShape(1, 1, 1, (6,))
    learner = make_learner(shape, norm='batch', target='none', action_l2=0.0, learning_rate=0.0)
    assert learner.target_critic is learner.critic
    linear, norm, _ = learner.critic.network.hidden
    output = learner.critic.network.output
    with torch.no_grad():
        norm.weight.uniform_(0.5, 1.5)
        norm.bias.uniform_(-0.5, 0.5)
        output.weight.mul_(0.4)
        output.bias.fill_(-0.7)
    network = copy.deepcopy(torch.nn.Sequential(linear, norm, torch.nn.ReLU(), output))
    # Next states lie elsewhere: neither alone has the statistics of both.
    batch = scattered()
    batch.next_observation[:] = 0.3 * batch.next_observation + 1.5
    features, next_features = (
        torch.from_numpy(np.concatenate([seen, batch.goal], axis=1))
        for seen in (batch.observation, batch.next_observation)
    )
    with torch.no_grad():
        own, following = learner.actor(features), learner.actor(next_features)
        inputs = torch.cat([features, torch.from_numpy(batch.action)], dim=1)
        next_inputs = torch.cat([next_features, following], dim=1)
        both = network.train()(torch.cat([inputs, next_inputs]))[:, 0].numpy()
        expected = network.eval()(torch.cat([features, own], dim=1)).mean().item()
    value, next_value = np.split(both, 2)
    target = batch.reward + batch.discount * next_value
    assert ((-2.0 < target) & (target < 0.0)).mean() > 0.5
    losses = learner.update(batch)
    error = value - np.clip(target, -2.0, 0.0)
    assert losses.critic.item() == pytest.approx(np.square(error).mean(), rel=1e-4)
    # The running statistics are replaced once: the actor does not count.
    torch.testing.assert_close(dict(norm.named_buffers()), dict(network[1].named_buffers()))
    assert norm.momentum == 0.01
    assert losses.value.item() == pytest.approx(expected, rel=1e-4)


def test_truncated_targets_leave_out_the_highest_of_all_critics_together():
    quantiles = torch.arange(50.0).reshape(2, 1, 25)
    assert sample_of(quantiles, truncated=False).shape == (1, 50)
    assert sample_of(quantiles, truncated=True)[0].tolist() == list(range(46))
    assert sample_of(torch.tensor([[3.0, 1.0, 2.0]]), truncated=True).tolist() == [[1.0, 2.0]]


def test_the_cost_is_least_at_the_quantiles_of_the_target():
    sample = torch.linspace(-20.0, 0.0, 1001)[None]
    best = torch.quantile(sample[0], torch.tensor([0.125, 0.375, 0.625, 0.875]))[None]
    cost = quantile_costs(best, sample)
    assert cost.shape == (1,)
    for index in range(4):
        for shift in (-1.0, 1.0):
            moved = best.clone()
            moved[0, index] += shift
            assert quantile_costs(moved, sample) > cost
    assert quantile_costs(best.expand(3, 1, 4), sample).shape == (3, 1)
