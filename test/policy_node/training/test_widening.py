"""Networks made wider say the same."""

from __future__ import annotations

import pytest
import torch

from policy_node.policies.actor import MLP, Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.training.learners.widening import can_widen, widened

BEFORE, AFTER = (6, 4, 5), (12, 4, 15)


def shape(sizes: tuple[int, ...], layer_norm: bool) -> NetworkShape:
    return NetworkShape(7, 3, 2, hidden_sizes=sizes, layer_norm=layer_norm)


@pytest.mark.parametrize('layer_norm', [False, True])
def test_wider_networks_say_the_same_and_their_copies_learn_different_things(
    layer_norm: bool,
) -> None:
    torch.manual_seed(0)
    old, new = Actor(shape(BEFORE, layer_norm)), Actor(shape(AFTER, layer_norm))
    new.load_state_dict(widened(old.state_dict(), AFTER))
    inputs = torch.randn(50, 10)
    torch.testing.assert_close(new(inputs), old(inputs))
    new(inputs).square().sum().backward()
    gradient = new.network.hidden[0].weight.grad
    assert gradient is not None
    first, second = gradient[:6], gradient[6:]
    assert (first.abs().sum() > 0) and not torch.allclose(first, second)


def test_a_network_and_its_slow_copy_become_wider_alike() -> None:
    torch.manual_seed(0)
    network = MLP(8, 1, shape(BEFORE, False))
    parts = ('critic.members.0.network.', 'target_critic.members.0.network.')
    tensors = {f'{part}{n}': v for part in parts for n, v in network.state_dict().items()}
    tensors['goal_statistics.total'] = torch.ones(3)
    wider = widened(tensors, AFTER)
    assert wider.keys() == tensors.keys()
    assert torch.equal(wider['goal_statistics.total'], torch.ones(3))
    for name in network.state_dict():
        assert torch.equal(wider[parts[0] + name], wider[parts[1] + name])


@pytest.mark.parametrize(
    ('after', 'allowed'),
    [((12, 4, 5), True), (BEFORE, True), ((9, 4, 5), False), ((6, 4), False), ((3, 4, 5), False)],
)
def test_widths_are_multiples(after: tuple[int, ...], allowed: bool) -> None:
    assert can_widen(BEFORE, after) is allowed
