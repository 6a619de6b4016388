"""DDPG and its critics against their definitions, and on problems with a known answer."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.config import Critics
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Transitions
from policy_node.training.learners.ddpg import DDPG
from policy_node.training.machine import Workers, choose_device, uses_bfloat16
from policy_node.training.research.critics import (
    Ensemble,
    critic_loss,
    quantile_costs,
    sample_of,
)
from policy_node.training.research.judged import bellman, uncertain
from policy_node.training.research.registry import make_ddpg
from support import learners

SHAPE = NetworkShape(observation_size=3, goal_size=2, action_size=2, hidden_sizes=(32, 32))
CPU = torch.device('cpu')


def make_learner(**changes):
    return learners.make_learner(SHAPE, **changes)


def scattered(count: int = 200, shape: NetworkShape = learners.SHAPE) -> Transitions:
    generator = np.random.default_rng(0)

    def uniform(limit: float, size: int) -> np.ndarray:
        return generator.uniform(-limit, limit, (count, size)).astype(np.float32)

    states = [uniform(2.0, shape.observation_size) for _ in range(2)]
    goal, action = uniform(2.0, shape.goal_size), uniform(1.0, shape.action_size)
    reward = -generator.integers(0, 2, count).astype(np.float32)
    # Returns differ in length, so discounts do.
    discount = generator.choice([0.5, 0.25], count).astype(np.float32)
    return Transitions(*states, goal, action, reward, discount)


def forward(module, inputs):
    """The network in numpy."""
    layer = inputs
    for part in module.hidden:
        if isinstance(part, torch.nn.Linear):
            layer = layer @ part.weight.detach().numpy().T + part.bias.detach().numpy()
        else:
            layer = np.maximum(layer, 0.0)
    return layer @ module.output.weight.detach().numpy().T + module.output.bias.detach().numpy()


def test_the_first_losses_are_those_of_the_definition():
    learner = make_learner(action_l2=0.7)
    before = copy.deepcopy(learner)
    batch = scattered(64, SHAPE)
    losses = learner.update(batch)
    features = np.concatenate([batch.observation, batch.goal], axis=1).clip(-5, 5)
    known = before.tensors(batch)
    target = before.targets(known.reward, known.discount, known.next_features).detach()
    value = forward(before.critic.network, np.concatenate([features, batch.action], axis=1))
    critic_loss = np.square(value[:, 0] - target.numpy()).mean()
    assert losses.critic.item() == pytest.approx(critic_loss, rel=1e-4)
    action = np.tanh(forward(before.actor.network, features))
    value = forward(learner.critic.network, np.concatenate([features, action], axis=1)).mean()
    assert losses.value.item() == pytest.approx(value, rel=1e-4, abs=1e-6)
    actor_loss = -value + 0.7 * np.square(action).mean()
    assert losses.actor.item() == pytest.approx(actor_loss, rel=1e-4, abs=1e-6)


def test_targets_move_by_the_share_and_at_the_interval_asked_for():
    learner = make_learner(polyak=0.75, target_update_interval=3)
    start = copy.deepcopy(learner.target_critic.state_dict())
    for _ in range(2):
        learner.update(scattered(64, SHAPE))
    moved = learner.target_critic.state_dict()
    assert all(torch.equal(start[name], moved[name]) for name in start)
    learner.update(scattered(64, SHAPE))
    for name, value in learner.target_critic.state_dict().items():
        expected = 0.75 * start[name] + 0.25 * learner.critic.state_dict()[name]
        torch.testing.assert_close(value, expected)


def test_a_delayed_actor_learns_at_every_third_update_of_the_critic():
    learner = make_learner(policy_delay=3)
    moved = []
    for _ in range(6):
        actor = copy.deepcopy(learner.actor.network.state_dict())
        critic = copy.deepcopy(learner.critic.state_dict())
        losses = learner.update(scattered(64, SHAPE))
        now = learner.actor.network.state_dict()
        moved.append(any(not torch.equal(actor[name], now[name]) for name in actor))
        assert any(not torch.equal(critic[n], v) for n, v in learner.critic.state_dict().items())
        assert losses.value != 0.0
    assert moved == [True, False, False, True, False, False]


def test_the_actor_update_leaves_the_critic_alone_and_normalizers_untouched():
    learner = make_learner(learning_rate=0.0)
    learner.actor_optimizer.param_groups[0]['lr'] = 0.1
    critic = copy.deepcopy(learner.critic.state_dict())
    actor = copy.deepcopy(learner.actor.state_dict())
    learner.update(scattered(64, SHAPE))
    assert all(torch.equal(critic[name], v) for name, v in learner.critic.state_dict().items())
    for name, value in learner.actor.state_dict().items():
        assert torch.equal(actor[name], value) == ('normalizer' in name), name


def test_the_averaged_actor_keeps_its_share_and_takes_the_rest_of_the_actor():
    config = recipe_config('FetchReach', 'paper', actor_average=0.9)
    learner = make_ddpg(NetworkShape(3, 2, 4, (8,)), config, CPU, Workers())
    old = copy.deepcopy(learner.actor.network.state_dict())
    with torch.no_grad():
        torch._foreach_add_(learner.actor_parameters, 1.0)
    for share in (0.1, 0.19):
        learner.average()
        evaluated, acting = learner.evaluation_actor(), learner.acting_policy()
        for name, value in old.items():
            torch.testing.assert_close(evaluated.network.state_dict()[name], value + share)
            torch.testing.assert_close(acting.network.state_dict()[name], value + 1.0)


def test_learning_rates_fall_linearly_to_the_share_asked_for():
    learner = make_learner(learning_rate=2e-3, final_learning_rate=0.1)
    for progress, expected in ((0.0, 2e-3), (0.5, 1.1e-3), (1.0, 2e-4), (1.5, 2e-4)):
        learner.set_progress(progress)
        for optimizer in learner.optimizers.values():
            assert optimizer.param_groups[0]['lr'] == pytest.approx(expected)


def test_under_bfloat16_the_output_layer_stays_float32():
    network = MLP(4, 1, SHAPE)
    with torch.no_grad():
        network.output.bias.fill_(-49.9)
        network.output.weight.mul_(1e-3)
    with torch.autocast('cpu', torch.bfloat16):
        hidden, value = network.hidden(torch.randn(8, 4)), network(torch.randn(8, 4))
    assert hidden.dtype == torch.bfloat16 and value.dtype == torch.float32
    assert not torch.equal(value, value.bfloat16().float())
    np.testing.assert_allclose(value.detach(), -49.9, atol=0.02)


def test_precision_and_device_choices():
    assert uses_bfloat16('bfloat16', CPU) and not uses_bfloat16('float32', CPU)
    assert choose_device('cpu') == CPU
    if not torch.cuda.is_available():
        assert choose_device('auto') == CPU
        with pytest.raises(ValueError, match='torch has no GPU'):
            choose_device('cuda')


def test_members_start_differently_and_have_an_axis_of_their_own() -> None:
    critic = critic_loss(Critics(critics=5)).make(3 - learners.SHAPE.action_size, learners.SHAPE)
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
    learner = learners.make_learner(**changes)
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
    learner = learners.make_learner(NetworkShape(1, 1, 1, (1,)), critics=critics, **changes)
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
    learner = learners.make_learner(
        shape, norm='batch', target='none', action_l2=0.0, learning_rate=0.0
    )
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
