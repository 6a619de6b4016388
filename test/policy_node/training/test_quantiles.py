"""Quantiles of the return, on returns whose quantiles are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policy_node.training.experience.replay import Transitions
from policy_node.training.research.critics import levels, quantile_costs, sample_of
from support.learners import make_learner

torch.set_num_threads(1)


def lottery(count, generator):
    """One state, one step: the return is -1 nine times of ten and else -9."""
    reward = np.where(generator.random(count) < 0.9, -1.0, -9.0).astype(np.float32)
    same = np.ones((count, 1), np.float32)
    action = generator.uniform(-1, 1, (count, 1)).astype(np.float32)
    return Transitions(same, same, same, action, reward, np.zeros(count, np.float32))


@pytest.mark.release
def test_the_quantiles_of_a_lottery_are_learnt_and_its_mean_with_them():
    learner = make_learner(quantiles=5, gamma=0.95)
    generator = np.random.default_rng(0)
    for _ in range(1500):
        learner.update(lottery(256, generator))
    one = torch.ones(1, 1)
    features = learner.actor.features(one, one)
    with torch.no_grad():
        found = learner.critic.outputs(features, one)[0]
        value = learner.critic(features, one)
    # Of five equal shares the lowest is -9 in half of its width: its middle lies on the step.
    torch.testing.assert_close(found[1:], torch.full((4,), -1.0), atol=0.3, rtol=0.0)
    assert -9.2 < float(found[0]) < -1.0
    assert float(value) == float(found.mean())


def test_truncated_targets_leave_out_the_highest_of_all_critics_together():
    quantiles = torch.arange(50.0).reshape(2, 1, 25)
    assert sample_of(quantiles, truncated=False).shape == (1, 50)
    assert sample_of(quantiles, truncated=True)[0].tolist() == list(range(46))
    assert sample_of(torch.tensor([[3.0, 1.0, 2.0]]), truncated=True).tolist() == [[1.0, 2.0]]


def test_the_cost_is_least_at_the_quantiles_of_the_target():
    sample = torch.linspace(-20.0, 0.0, 1001)[None]
    best = torch.quantile(sample[0], levels(4, sample))[None]
    cost = quantile_costs(best, sample)
    assert cost.shape == (1,)
    for index in range(4):
        for shift in (-1.0, 1.0):
            moved = best.clone()
            moved[0, index] += shift
            assert quantile_costs(moved, sample) > cost
    assert quantile_costs(best.expand(3, 1, 4), sample).shape == (3, 1)
