"""Which finger a policy of HandReach meets its goals with, and how far away the others stay.

A goal brings the thumb and one other finger together, or leaves all where they are. Episodes are
sorted by the finger that their goal moves most beside the thumb.

python bench/hand_reach_fingers.py HandReach --episodes 500
python bench/hand_reach_fingers.py runs/reach/latest.safetensors
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.robots import FINGERTIPS
from policy_node import load_policy
from policy_node.policies.policy import Policy
from policy_node.training.evaluation.episodes import FIRST_SEED

# A goal asks a finger to move where it is farther away than this, metres.
_ASKED = 0.02
_THUMB = FINGERTIPS.index('thtip')

Array = NDArray[np.float64]


def last_distances(policy: Policy, episodes: int) -> tuple[Array, Array]:
    """Distances (episodes, 5) of the fingertips from their goals, metres: at first and at last."""
    simulation = Simulation('HandReach', num_envs=episodes)
    observation = simulation.reset(seed=list(range(FIRST_SEED, FIRST_SEED + episodes)))
    first = _distances(observation['achieved_goal'], observation['desired_goal'])
    for _ in range(simulation.spec.episode_ticks):
        action, _ = policy.predict(observation, deterministic=True)
        observation = simulation.step(action).observation
    return first, _distances(observation['achieved_goal'], observation['desired_goal'])


def _distances(achieved: Array, desired: Array) -> Array:
    found: Array = np.linalg.norm((achieved - desired).reshape(len(desired), 5, 3), axis=-1)
    return found


def main() -> int:
    """Prints a row per finger; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('policy', help='name of a shipped actor, or a file')
    parser.add_argument('--episodes', type=int, default=500, help='default: 500')
    options = parser.parse_args()
    first, last = last_distances(load_policy(options.policy).policy, options.episodes)
    others = [index for index in range(len(FINGERTIPS)) if index != _THUMB]
    asked = np.where((first > _ASKED)[:, others].any(axis=1), first[:, others].argmax(axis=1), -1)
    threshold = Simulation('HandReach').spec.distance_threshold
    print(f'{"goal moves":12} {"episodes":>8} {"success":>8} {"distance in the median, mm":>28}')
    for place, index in enumerate([*others, _THUMB]):
        rows = asked == (place if index != _THUMB else -1)
        if not rows.any():
            continue
        distance = np.linalg.norm(last[rows], axis=1)
        name = FINGERTIPS[index] if index != _THUMB else 'none'
        met, middle = (distance < threshold).mean(), 1e3 * np.median(distance)
        print(f'{name:12} {rows.sum():8} {met:8.2f} {middle:28.1f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
