"""Where goals in hindsight pull an on-policy actor that does not know how to push yet.

Noise around no action, on FetchPush; every episode is replayed for goals of one source, as if it
had acted for them. Printed is the gradient by which a policy gradient would move the actor's
action: the sum over an episode of advantage times noise, towards the block and upwards, over
the noise's variance, with its standard error over episodes. Advantages are discounted returns less
their mean at that tick. Positive is towards the block (docs/research/onpolicy).

python bench/hindsight_pull.py
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from noisy_episodes import noisy_episodes

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.arrays import Array
from policy_node.policies.policy import RestingPolicy
from policy_node.training.experience.replay import Episodes
from policy_node.training.research.rollouts import Outcomes, advantages, goals_in_hindsight

_TASK, _GAMMA = 'FetchPush', 0.98
_SOURCES = {
    'real': 'desired goals',
    'future': 'later ones of the episode itself',
    'final': 'the last one of the episode itself',
    'outcome': 'what other episodes brought about',
}


def main() -> int:
    """Prints a row per source; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--noise', type=float, default=0.8, help='default: 0.8')
    parser.add_argument('--episodes', type=int, default=2048, help='default: 2048')
    options = parser.parse_args()
    simulation = Simulation(_TASK, num_envs=options.episodes)
    resting = RestingPolicy(simulation.spec.robot.action_size)
    episodes = noisy_episodes(simulation, resting, options.noise, range(options.episodes))
    noise = episodes.action
    generator = np.random.default_rng(1)
    outcomes = Outcomes.of(episodes, GoalMetric(simulation.spec), generator)
    gripper, block = (episodes.observation[:, :-1, at : at + 3] for at in (0, 3))
    towards = (block - gripper) / np.linalg.norm(block - gripper, axis=-1, keepdims=True)
    print(f'{"goals":36s} return   towards the block      upwards')
    for source, label in _SOURCES.items():
        goal = goals_in_hindsight(episodes, {source: 1.0}, generator, outcomes)
        returns = _returns(simulation, episodes, goal)
        advantage = (returns - returns.mean(axis=0)) / options.noise**2
        pulls = [
            (advantage * (noise[..., :3] * towards).sum(axis=-1)).sum(axis=1),
            (advantage * noise[..., 2]).sum(axis=1),
        ]
        columns = '  '.join(_with_error(pull) for pull in pulls)
        print(f'{label:36s} {returns[:, 0].mean():6.2f}  {columns}')
    return 0


def _returns(simulation: Simulation, episodes: Episodes, goal: Array) -> Array:
    """Discounted rewards to the end of the episode, (episodes, T)."""
    achieved = episodes.achieved_goal[:, 1:]
    reward = simulation.compute_reward(achieved, np.broadcast_to(goal[:, None], achieved.shape))
    nothing = np.zeros((len(episodes), episodes.ticks + 1))
    return advantages(np.asarray(reward), nothing, _GAMMA, trace=1.0)


def _with_error(values: Array) -> str:
    return f'{values.mean():8.2f} +- {values.std() / np.sqrt(len(values)):5.2f}'


if __name__ == '__main__':
    sys.exit(main())
