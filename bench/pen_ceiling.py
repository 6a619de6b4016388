"""Which goals of the pen can be reached at all under the success rule of the released code.

The rule sets the Euler z of the achieved rotation to that of the goal and then compares the two
quaternions as they come out, so that q and -q lie 2 pi apart. For each goal this searches for the
orientation of the pen with the smallest remaining angle: if that is not below the threshold, no
pose of the pen whatever succeeds, hand or no hand.

python bench/pen_ceiling.py --episodes 2000
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.rotations import euler_to_quaternion, quaternion_to_euler
from policy_node.training.evaluation import FIRST_SEED, wilson_interval

TASKS = ('HandManipulatePenRotate', 'HandManipulatePenFull')


def goals_of(task: str, episodes: int) -> Array:
    """Goals (episodes, 7) of the episodes behind the README's numbers."""
    simulation = Simulation(task, num_envs=min(episodes, 100))
    found: list[Array] = []
    while len(found) * simulation.num_envs < episodes:
        first = FIRST_SEED + len(found) * simulation.num_envs
        seeds = list(range(first, first + simulation.num_envs))
        found.append(simulation.reset(seed=seeds)['desired_goal'].copy())
    return np.concatenate(found)[:episodes]


def smallest_rotation(task: str, goals: Array, generator: np.random.Generator) -> Array:
    """Smallest rotation to each goal that the rule gives any orientation, radians.

    Only Euler x and y of an orientation count, so a grid around those of the goal (which wraps at
    their ends, where signs change) finds what is near; random orientations look everywhere else.
    """
    metric = Simulation(task, num_envs=1).metric
    best = np.full(len(goals), np.inf)
    euler = quaternion_to_euler(goals[:, 3:])
    steps = np.linspace(-0.1, 0.1, 21)
    near = [np.array([x, y, 0.0]) for x in steps for y in steps]
    far = list(generator.uniform(-np.pi, np.pi, (200, 3)))
    for turn in near + far:
        achieved = goals.copy()
        achieved[:, 3:] = euler_to_quaternion(euler + turn)
        best = np.minimum(best, metric.distances(achieved, goals)[1])
    return best


def has_other_sign(goals: Array) -> NDArray[np.bool_]:
    """Return whether conversion to Euler angles and back flips the sign of a goal's quaternion."""
    there_and_back = euler_to_quaternion(quaternion_to_euler(goals[:, 3:]))
    return np.asarray((there_and_back * goals[:, 3:]).sum(axis=-1) < 0.0)


def main() -> int:
    """Prints the shares; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--episodes', type=int, default=2000, help='default: 2000')
    episodes = parser.parse_args().episodes
    print('| task | goals | reachable by some orientation | 95 % interval | q turns into -q |')
    print('| --- | --- | --- | --- | --- |')
    for task in TASKS:
        goals = goals_of(task, episodes)
        threshold = Simulation(task, num_envs=1).spec.rotation_threshold or np.inf
        rotation = smallest_rotation(task, goals, np.random.default_rng(0))
        reachable = int((rotation < threshold).sum())
        low, high = wilson_interval(reachable, episodes)
        print(
            f'| {task} | {episodes} | {reachable / episodes:.3f} | {low:.3f} ... {high:.3f} '
            f'| {has_other_sign(goals).mean():.3f} |'
        )
    return 0


if __name__ == '__main__':
    sys.exit(main())
