"""Collection of episodes from the real simulation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.actor import Actor
from policy_node.policies.network_shape import NetworkShape
from policy_node.policies.policy import RestingPolicy
from policy_node.training.configuration.flat import from_flat
from policy_node.training.experience.collector import Collector


def make_collector(noise_std=0.2, random_epsilon=0.3, envs=4):
    simulation = Simulation('FetchReach', num_envs=envs, num_threads=1)
    config = from_flat({'task': 'FetchReach'}, noise_std=noise_std, random_epsilon=random_epsilon)
    return Collector(simulation, [10 * i for i in range(envs)], config)


def make_actor():
    torch.manual_seed(0)
    return Actor(NetworkShape(10, 3, 4, (16,))).eval()


def test_episodes_are_what_the_simulation_does_with_the_actions():
    collector = make_collector()
    episodes, success = collector.collect(make_actor())
    assert (len(episodes), episodes.ticks) == (4, 50)
    simulation = Simulation('FetchReach', num_envs=4, num_threads=1)
    observation = simulation.reset(seed=[0, 10, 20, 30])
    reached = np.zeros(4, bool)
    for tick in range(50):
        expected = observation['observation'].astype(np.float32)
        np.testing.assert_array_equal(episodes.observation[:, tick], expected)
        result = simulation.step(episodes.action[:, tick])
        observation, reached = result.observation, result.success
    np.testing.assert_array_equal(
        episodes.achieved_goal[:, 50], observation['achieved_goal'].astype(np.float32)
    )
    np.testing.assert_array_equal(
        episodes.desired_goal, observation['desired_goal'].astype(np.float32)
    )
    assert success == reached.mean()
    following, _ = collector.collect(make_actor())
    assert (following.desired_goal != episodes.desired_goal).all(), 'later cycles have new goals'


@pytest.mark.parametrize('epsilon', [0.0, 0.3])
def test_noise_has_the_spread_and_the_share_asked_for(epsilon):
    episodes, _ = make_collector(0.1, epsilon, envs=20).collect(RestingPolicy(4))
    actions = episodes.action.reshape(-1, 4)
    assert np.abs(actions).max() <= 1.0
    # Five standard deviations of the Gaussian; a uniform action stays inside with 0.5 ** 4.
    outside = (np.abs(actions) > 0.5).any(axis=1).mean()
    assert outside == pytest.approx(epsilon * (1 - 0.5**4), abs=0.04)
    inside = actions[(np.abs(actions) <= 0.5).all(axis=1)]
    assert inside.std() == pytest.approx(0.1, abs=0.012)
