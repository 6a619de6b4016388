"""The DDPG update against its definition, and on a problem with a known answer."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from policy_node.policies.actor import MLP
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.experience.replay import Transitions
from policy_node.training.machine import Workers, choose_device, uses_bfloat16
from policy_node.training.research.registry import make_ddpg
from support import learners

SHAPE = NetworkShape(observation_size=3, goal_size=2, action_size=2, hidden_sizes=(32, 32))
CPU = torch.device('cpu')


def make_learner(layer_norm=False, **changes):
    shape = NetworkShape(3, 2, 2, (32, 32), layer_norm)
    return learners.make_learner(shape, **{'gamma': 0.9, 'learning_rate': 1e-3, **changes})


def make_batch(count=64, seed=0, reward=None):
    generator = np.random.default_rng(seed)

    def normal(*shape):
        return generator.normal(size=shape).astype(np.float32)

    rewards = -generator.integers(0, 2, count).astype(np.float32)
    return Transitions(
        observation=normal(count, 3),
        next_observation=normal(count, 3),
        goal=normal(count, 2),
        action=np.tanh(normal(count, 2)),
        reward=rewards if reward is None else np.full(count, reward, np.float32),
        discount=np.full(count, 0.9, np.float32),
    )


def torch_arrays(*arrays):
    return [torch.from_numpy(array) for array in arrays]


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
    batch = make_batch()
    losses = learner.update(batch)
    features = np.concatenate([batch.observation, batch.goal], axis=1).clip(-5, 5)
    next_features = np.concatenate([batch.next_observation, batch.goal], axis=1).clip(-5, 5)
    with torch.no_grad():
        target = before.targets(*torch_arrays(batch.reward, batch.discount, next_features))
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
        learner.update(make_batch())
    moved = learner.target_critic.state_dict()
    assert all(torch.equal(start[name], moved[name]) for name in start)
    learner.update(make_batch())
    for name, value in learner.target_critic.state_dict().items():
        expected = 0.75 * start[name] + 0.25 * learner.critic.state_dict()[name]
        torch.testing.assert_close(value, expected)


def test_a_delayed_actor_learns_at_every_third_update_of_the_critic():
    learner = make_learner(policy_delay=3)
    moved = []
    for _ in range(6):
        actor = copy.deepcopy(learner.actor.network.state_dict())
        critic = copy.deepcopy(learner.critic.state_dict())
        losses = learner.update(make_batch())
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
    learner.update(make_batch())
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
        for optimizer in learner.optimizers().values():
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
