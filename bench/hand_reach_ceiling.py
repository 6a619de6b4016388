"""Which goals of HandReach can be reached at all under the success rule of the released code.

For each goal this searches for joint angles within their ranges that bring the five fingertips as
close as possible, by damped least squares from several starts. Contacts, gravity and the coupling
of the last two joints of a finger are left out, so that a goal which is further away than the
threshold here cannot be reached by any policy: the share of the others bounds success from above.

python bench/hand_reach_ceiling.py --episodes 2000
"""

from __future__ import annotations

import argparse
import sys

import mujoco
import numpy as np

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from policy_node.training.evaluation import FIRST_SEED, wilson_interval

_STARTS, _STEPS, _DAMPING = 6, 120, 1e-5


class Hand:
    """Kinematics of the fingertips."""

    def __init__(self) -> None:
        simulation = Simulation('HandReach', num_envs=1)
        self._simulation = simulation
        self.model = simulation.model
        self.data = mujoco.MjData(self.model)
        start = simulation.reset(seed=0)['achieved_goal'][0].reshape(5, 3)
        self.data.qpos[:] = simulation.data(0).qpos
        mujoco.mj_forward(self.model, self.data)
        self.start = self.data.qpos.copy()
        distance = np.linalg.norm(self.data.site_xpos[:, None] - start, axis=-1)
        self._sites = distance.argmin(axis=0)
        assert distance.min(axis=0).max() < 1e-9, 'the sites that are the achieved goal'
        self._low, self._high = self.model.jnt_range.T
        self.threshold = simulation.spec.distance_threshold

    def goals(self, episodes: int) -> Array:
        """Goals (episodes, 15) of the episodes behind the README's numbers."""
        reset = self._simulation.reset
        rows = [reset(seed=FIRST_SEED + i)['desired_goal'][0].copy() for i in range(episodes)]
        return np.array(rows)

    def smallest_distance(self, goal: Array, generator: np.random.Generator) -> float:
        """Smallest norm over the fifteen coordinates that any start leads to, metres."""
        best = np.inf
        for attempt in range(_STARTS):
            position = self.start.copy()
            if attempt:
                position = generator.uniform(self._low, self._high)
            best = min(best, self._descend(goal, position, enough=self.threshold))
            if best < self.threshold:
                break
        return best

    def _descend(self, goal: Array, position: Array, enough: float) -> float:
        best, damping, jacobian = np.inf, _DAMPING, np.zeros((15, self.model.nv))
        for _ in range(_STEPS):
            self.data.qpos[:] = position
            mujoco.mj_kinematics(self.model, self.data)
            mujoco.mj_comPos(self.model, self.data)
            error = goal - self.data.site_xpos[self._sites].ravel()
            distance = float(np.linalg.norm(error))
            damping = damping * 0.7 if distance < best else min(damping * 3.0, 1e-1)
            best = min(best, distance)
            if best < enough:
                break
            for row, site in enumerate(self._sites):
                mujoco.mj_jacSite(
                    self.model, self.data, jacobian[3 * row : 3 * row + 3], None, int(site)
                )
            position = position + self._step(jacobian, error, position, damping)
        return best

    def _step(self, jacobian: Array, error: Array, position: Array, damping: float) -> Array:
        """Damped least squares; joints that would leave their range stay at its end."""
        free, step = np.ones(len(position), np.bool_), np.zeros(len(position))
        for _ in range(4):
            part = jacobian[:, free]
            system = part @ part.T + max(damping, 1e-8) * np.eye(len(error))
            step[free] = part.T @ np.linalg.solve(system, error - jacobian[:, ~free] @ step[~free])
            beyond = (position + step < self._low) | (position + step > self._high)
            step = np.clip(position + step, self._low, self._high) - position
            if not (beyond & free).any():
                break
            free &= ~beyond
        return step


def main() -> int:
    """Prints the share; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--episodes', type=int, default=2000, help='default: 2000')
    episodes = parser.parse_args().episodes
    hand, generator = Hand(), np.random.default_rng(0)
    distances = np.array([hand.smallest_distance(g, generator) for g in hand.goals(episodes)])
    reachable = int((distances < hand.threshold).sum())
    low, high = wilson_interval(reachable, episodes)
    print(
        f'{reachable} of {episodes} goals within {hand.threshold:g} m: {reachable / episodes:.3f}'
    )
    print(f'95 % interval {low:.3f} ... {high:.3f}')
    missed = distances[distances >= hand.threshold]
    if missed.size:
        print(f'the others: median {np.median(missed):.4f} m, smallest {missed.min():.4f} m')
    return 0


if __name__ == '__main__':
    sys.exit(main())
