"""Values of a critic beside the returns of its actor."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from policy_node.training.critic_bias import main
from policy_node.training.values_and_returns import discounted, measure
from support.runs import trainer_of


def saved_run(folder, value, **changes):
    """A run of FetchReach whose critic is constant."""
    trainer = trainer_of(folder, num_envs=2, evaluation_episodes=2, **changes)
    critic = trainer.learner.critic
    with torch.no_grad():
        for name, parameter in critic.named_parameters():
            if 'output' in name:
                parameter.fill_(value if name.endswith('bias') else 0.0)
    trainer.save()
    return folder


def test_returns_go_on_as_the_last_ticks_were():
    rewards = np.full((30, 2), -1.0)
    rewards[20:, 1] = 0.0
    returns = discounted(rewards, 0.9)
    np.testing.assert_allclose(returns[:, 0], -10.0)
    # Half of the last twenty ticks were met.
    following = -5.0
    np.testing.assert_allclose(returns[29, 1], 0.9 * following)
    np.testing.assert_allclose(returns[19, 1], -1.0 + 0.9**11 * following)


def test_a_critic_that_overestimates_is_shown(tmp_path, capsys):
    """An untrained actor always fails: the return of its actions is -1/(1 - gamma)."""
    run = saved_run(tmp_path, value=-3.0)
    found = measure(run, episodes=2)
    assert [each.tick for each in found] == [0, 12, 25]
    assert all(each.value == pytest.approx(-3.0) for each in found)
    returns = [each.episode_return for each in found]
    assert returns == pytest.approx([-50.0] * 3, abs=2.0)
    assert np.isnan(found[0].correlation)
    assert main([str(run), '--episodes', '2']) == 0
    assert 'correlation' in capsys.readouterr().out


MANY = {'quantiles': 5, 'aggregate': 'truncated'}


@pytest.mark.parametrize('changes', [MANY, MANY | {'critics': 2}, {'past_actions': 2}], ids=str)
def test_values_are_read_from_other_networks(tmp_path, changes):
    run = saved_run(tmp_path, value=-3.0, **changes)
    assert [each.value for each in measure(run, episodes=2)] == pytest.approx([-3.0] * 3)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'condition': 'threshold'}, 'condition threshold'),
        ({'subgoal_every': 10}, 'subgoal_every 10'),
        (None, 'is no file'),
    ],
)
def test_runs_without_values_of_actions_are_rejected(tmp_path, changes, message, capsys):
    if changes is not None:
        saved_run(tmp_path, value=0.0, **changes)
    assert main([str(tmp_path)]) == 2
    assert message in capsys.readouterr().err
