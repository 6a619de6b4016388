"""Ensembles, their normalisation and their word as one, on problems with a known answer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from policy_node.training.configuration.config import TrainConfig
from policy_node.training.networks.critics import AGGREGATES, Ensemble, make_critic
from policy_node.training.replay.transitions import Transitions
from support.learners import SHAPE, make_learner

torch.set_num_threads(1)


@pytest.mark.parametrize(
    ('name', 'expected'),
    [('mean', [-3.0, -2.0]), ('min', [-5.0, -2.5]), ('truncated', [-4.0, -2.25])],
)
def test_what_an_ensemble_says_as_one(name: str, expected: list[float]) -> None:
    values = torch.tensor([[-1.0, -2.0], [-5.0, -2.5], [-3.0, -1.5]])
    torch.testing.assert_close(AGGREGATES[name](values), torch.tensor(expected))


def test_members_start_differently_and_have_an_axis_of_their_own() -> None:
    critic = make_critic(TrainConfig('FetchReach', critics=5), 3 - SHAPE.action_size, SHAPE)
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
        {'target': 'none'},
        {'target': 'none', 'norm': 'layer'},
        {'target': 'none', 'norm': 'batch'},
        {'critics': 3, 'aggregate': 'min', 'target_update_interval': 5},
        {'critics': 2, 'aggregate': 'truncated', 'norm': 'layer', 'target': 'none'},
        {'quantiles': 5, 'target_update_interval': 5},
        {'critics': 2, 'quantiles': 5, 'aggregate': 'truncated', 'target_update_interval': 5},
    ],
    ids=str,
)
def test_values_of_a_chain_are_its_discounted_rewards(changes: dict[str, object]) -> None:
    learner = make_learner(**changes)
    generator = np.random.default_rng(0)
    state = torch.arange(4.0)[:, None]
    features = learner.actor.features(state, torch.full((4, 1), 3.0))
    seen = []
    for update in range(600):
        learner.update(chain_batch(64, generator))
        if update >= 300:
            with torch.no_grad():
                values = learner.critic(features, torch.zeros(4, 1))
            seen.append((values if values.ndim == 1 else values.mean(dim=0)).numpy())
    # The average: without target networks batch normalisation keeps them moving by 0.2.
    atol = 0.2 if changes.get('norm') == 'batch' else 0.15
    np.testing.assert_allclose(np.mean(seen, axis=0), [-1.5, -1.0, 0.0, 0.0], atol=atol)


def test_without_target_networks_there_are_none_to_move() -> None:
    learner = make_learner(target='none')
    assert learner.target_critic is learner.critic
    learner.update(chain_batch(64, np.random.default_rng(0)))


def test_disagreement_is_where_nothing_was_learnt() -> None:
    learner = make_learner(critics=3, target='none')
    generator = np.random.default_rng(0)
    for _ in range(300):
        learner.update(chain_batch(64, generator))
    known = chain_batch(64, generator)
    elsewhere = np.full((64, 1), -40.0, np.float32)
    unknown = replace(known, goal=elsewhere)
    assert learner.disagreement(known).mean() < 0.05 < learner.disagreement(unknown).mean()
    assert learner.surprise(known).mean() < 0.05 and learner.surprise(known).shape == (64,)
