"""One episode in the installed environments, one copy and many; nothing of a checkout is used."""

from __future__ import annotations

import sys
from pathlib import Path

import gymnasium

import fetch_hand_sim

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """Runs the episodes; returns the exit code."""
    if Path(fetch_hand_sim.__file__).is_relative_to(ROOT):
        print(f'fetch_hand_sim is that of {ROOT}, not an installed one', file=sys.stderr)
        return 1
    env = gymnasium.make('fetch_hand_sim/FetchReach-v0')
    env.reset(seed=0)
    env.action_space.seed(0)
    is_over, steps = False, 0
    while not is_over:
        _, _, terminated, truncated, info = env.step(env.action_space.sample())
        is_over, steps = terminated or truncated, steps + 1
    envs = gymnasium.make_vec(
        'fetch_hand_sim/HandReach-v0', num_envs=4, vectorization_mode='vector_entry_point'
    )
    observation, _ = envs.reset(seed=0)
    print(f'{steps} steps of FetchReach, success {info["is_success"]}; ', end='')
    print(f'4 x HandReach: {observation["observation"].shape}')
    return 0 if steps == 50 else 1


if __name__ == '__main__':
    sys.exit(main())
