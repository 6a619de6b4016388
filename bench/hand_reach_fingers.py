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

from fetch_hand_sim.simulation import Simulation
from msgs_spec.robots import FINGERTIPS
from policy_node import load_policy
from policy_node.training.evaluation import FIRST_SEED, run_episodes

# A finger has to move if its goal is farther away than this, in metres.
_ASKED = 0.02
# The thumb, which is last, moves whichever finger does.
_FINGERS = FINGERTIPS[:-1]


def main() -> int:
    """Prints a row per finger; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('policy', help='name of a shipped actor, or a file')
    parser.add_argument('--episodes', type=int, default=500, help='default: 500')
    options = parser.parse_args()
    simulation = Simulation('HandReach', num_envs=options.episodes)
    seeds = list(range(FIRST_SEED, FIRST_SEED + options.episodes))
    start = simulation.reset(seed=seeds)
    ways = (start['desired_goal'] - start['achieved_goal']).reshape(len(seeds), -1, 3)
    way = np.linalg.norm(ways, axis=-1)[:, : len(_FINGERS)]
    asked = np.where(way.max(axis=1) > _ASKED, way.argmax(axis=1), len(_FINGERS))
    outcomes = run_episodes(simulation, load_policy(options.policy).policy, seeds)
    print(f'{"goal moves":12} {"episodes":>8} {"success":>8} {"distance in the median, mm":>28}')
    for index, name in enumerate([*_FINGERS, 'none']):
        rows = asked == index
        if rows.any():
            met = outcomes.success_gymnasium[rows].mean()
            middle = 1e3 * np.median(outcomes.final_distance[rows])
            print(f'{name:12} {rows.sum():8} {met:8.2f} {middle:28.1f}')
    return 0


if __name__ == '__main__':
    sys.exit(main())
