"""In how many episodes of FetchPush a policy moves the block, and where its gripper goes.

On-policy learning uses the noisy episodes of its own policy alone. If they never move the block,
it cannot learn (docs/research/onpolicy).

python bench/pushes.py none --noise .8
python bench/pushes.py runs/push/latest.safetensors --noise .8
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from noisy_episodes import noisy_episodes

from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import task_spec
from policy_node import load_policy
from policy_node.policies.policy import Policy, RestingPolicy
from policy_node.training.evaluation import FIRST_SEED
from policy_node.training.experience.replay import MOVED_DISTANCE

_TASK = 'FetchPush'


def main() -> int:
    """Prints one row; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('policy', help='name of a shipped actor, a file, or `none` for no action')
    parser.add_argument('--noise', type=float, default=0.0, help='standard deviation; default: 0')
    parser.add_argument('--episodes', type=int, default=500, help='default: 500')
    options = parser.parse_args()
    spec = task_spec(_TASK)
    resting = options.policy == 'none'
    policy: Policy = (
        RestingPolicy(spec.robot.action_size) if resting else load_policy(options.policy).policy
    )
    moved, way = _run(policy, options.noise, options.episodes)
    print(f'block moved in {moved:.3f} of {options.episodes} episodes;', end=' ')
    print('gripper at the end', ' '.join(f'{value:+.2f}' for value in way), 'm from its start')
    return 0


def _run(policy: Policy, noise: float, episodes: int) -> tuple[float, np.ndarray]:
    """Share of episodes that move the block, and the mean way of the gripper (3,), metres."""
    simulation = Simulation(_TASK, num_envs=episodes)
    found = noisy_episodes(simulation, policy, noise, range(FIRST_SEED, FIRST_SEED + episodes))
    offset = found.achieved_goal - found.achieved_goal[:, :1]
    farthest = np.linalg.norm(offset, axis=-1).max(axis=1)
    way = (found.observation[:, -1] - found.observation[:, 0])[:, :3].mean(axis=0)
    return float((farthest > MOVED_DISTANCE).mean()), way


if __name__ == '__main__':
    sys.exit(main())
