"""Whole episodes of a policy with noise around it, for benches that ask what noise leads to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import Policy
from policy_node.training.experience.collector import ActionNoise
from policy_node.training.experience.replay import Episodes


def noisy_episodes(
    simulation: Simulation, policy: Policy, noise: float, seeds: Sequence[int]
) -> Episodes:
    """An episode of each simulation, from a reset with these seeds.

    Args:
        simulation: The simulations.
        policy: What acts.
        noise: Standard deviation around its actions, which are clipped afterwards.
        seeds: One per simulation.
    """
    spec, shape = simulation.spec, (simulation.num_envs, simulation.spec.robot.action_size)
    disturb = ActionNoise(np.random.default_rng(0), shape, noise, epsilon=0.0)
    states, actions = [simulation.reset(seed=list(seeds))], []
    for tick in range(spec.episode_ticks):
        action, _ = policy.predict(states[-1])
        actions.append(disturb.around(action, tick).clip(-1.0, 1.0))
        states.append(simulation.step(actions[-1]).observation)
    parts = (np.stack([state[name] for state in states], 1) for name in states[0])
    found = dict(zip(states[0], parts, strict=True))
    goal, action = found['desired_goal'][:, 0], np.stack(actions, axis=1)
    return Episodes(found['observation'], found['achieved_goal'], goal, action)
