"""How many of the replayed episodes a per-decision weight leaves, tick by tick.

`importance=decision` weighs a step of a replayed episode by the probability of all its actions so
far for the new goal over that for the old one. Episodes of an on-policy actor of FetchReach are
replayed for later goals of their own; printed is the effective number of episodes at some ticks,
(sum w)^2 / sum w^2 (docs/research/onpolicy).

python bench/decision_weights.py runs/research/onpolicy/FetchReach/weighed/seed0/latest.safetensors
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import torch
from noisy_episodes import noisy_episodes

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from policy_node import load_actor
from policy_node.policies.policy import Policy
from policy_node.training.experience.replay import Episodes
from policy_node.training.research.ppo import log_probability
from policy_node.training.research.rollouts import decision_weights, goals_in_hindsight

_TASK, _TICKS = 'FetchReach', (0, 4, 9, 24, 49)


def main() -> int:
    """Prints a row; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('actor', help='file of an actor of FetchReach')
    parser.add_argument('--noise', type=float, default=0.3, help='default: 0.3')
    parser.add_argument('--episodes', type=int, default=256, help='default: 256')
    options = parser.parse_args()
    actor = load_actor(options.actor, _TASK)
    simulation = Simulation(_TASK, num_envs=options.episodes)
    episodes = noisy_episodes(simulation, actor, options.noise, range(options.episodes))
    goals = goals_in_hindsight(episodes, {'future': 1.0}, np.random.default_rng(0))
    meant = _log_probabilities(actor, episodes, episodes.desired_goal, options.noise)
    logs = _log_probabilities(actor, episodes, goals, options.noise) - meant
    weight = decision_weights(logs)
    left = weight.sum(axis=0) ** 2 / np.square(weight).sum(axis=0)
    print(f'effective episodes of {options.episodes}, noise {options.noise:g}:', end=' ')
    print(', '.join(f'{left[tick]:.0f} at tick {tick}' for tick in _TICKS))
    return 0


def _log_probabilities(actor: Policy, episodes: Episodes, goal: Array, noise: float) -> Array:
    """Of the actions (episodes, T), had they been for these goals (episodes, goal_size)."""
    count, ticks = episodes.action.shape[:2]
    states = {
        'observation': episodes.observation[:, :-1],
        'achieved_goal': episodes.achieved_goal[:, :-1],
        'desired_goal': np.broadcast_to(goal[:, None], (count, ticks, goal.shape[-1])),
    }
    mean, _ = actor.predict(states)
    found: Array = log_probability(
        torch.from_numpy(np.asarray(mean, np.float64)), noise, torch.from_numpy(episodes.action)
    ).numpy()
    return found


if __name__ == '__main__':
    sys.exit(main())
