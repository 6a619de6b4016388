"""The actor: normalisation, predict, and finding a checkpoint."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policy_node.policies.actor import Actor, Normalizer
from policy_node.policies.network_shape import NetworkShape

SHAPE = NetworkShape(observation_size=10, goal_size=3, action_size=4, hidden_sizes=(16, 16))


def make_actor(layer_norm: bool = False) -> Actor:
    torch.manual_seed(3)
    actor = Actor(NetworkShape(10, 3, 4, (16, 16), layer_norm)).eval()
    actor.observation_normalizer.mean.copy_(torch.linspace(-1, 1, 10))
    actor.goal_normalizer.std.fill_(0.5)
    return actor


def make_observation(count: int) -> dict[str, np.ndarray]:
    generator = np.random.default_rng(0)
    return {
        'observation': generator.normal(size=(count, 10)),
        'achieved_goal': generator.normal(size=(count, 3)),
        'desired_goal': generator.normal(size=(count, 3)),
    }


def test_normalizer_clips_input_then_scales_then_clips() -> None:
    normalizer = Normalizer(4)
    normalizer.mean.copy_(torch.tensor([0.0, 1.0, 150.0, 0.0]))
    normalizer.std.copy_(torch.tensor([1.0, 2.0, 25.0, 0.01]))
    values = normalizer(torch.tensor([-3.0, 2.0, 1e9, 1.0]))
    assert values.tolist() == [-3.0, 0.5, 2.0, 5.0]


def test_predict_is_the_network_written_out() -> None:
    actor = make_actor()
    observation = make_observation(7)
    mean, std = np.linspace(-1, 1, 10), 0.5
    layer = np.concatenate(
        [
            np.clip(observation['observation'] - mean, -5, 5),
            np.clip(observation['desired_goal'] / std, -5, 5),
        ],
        axis=1,
    )
    linear = [m for m in actor.network.modules() if isinstance(m, torch.nn.Linear)]
    for index, module in enumerate(linear):
        layer = layer @ module.weight.detach().numpy().T + module.bias.detach().numpy()
        layer = np.tanh(layer) if index == len(linear) - 1 else np.maximum(layer, 0.0)
    action, state = actor.predict(observation)
    assert state is None
    assert action.dtype == np.float32 and action.shape == (7, 4)
    np.testing.assert_allclose(action, layer, atol=1e-5)


def test_predict_rejects_missing_parts_and_wrong_shapes() -> None:
    actor, observation = make_actor(), make_observation(2)
    with pytest.raises(ValueError, match="'desired_goal'"):
        actor.predict({k: v for k, v in observation.items() if k != 'desired_goal'})
    with pytest.raises(ValueError, match=r'\(2, 9\)'):
        actor.predict({**observation, 'observation': observation['observation'][:, :9]})
