"""Play random actions in Gymnasium-Robotics and record its answers.

Runs in a process of its own under `python -O`: on MuJoCo >= 3.17 that package stops at an `assert`
which compares an enum with a NumPy integer, and on other rates at one on its metadata.

Usage: python -O gymnasium_robotics_oracle.py <environment id> <seeds> <steps> <substeps> <file.npz>
"""

from __future__ import annotations

import sys
import warnings

import gymnasium
import numpy as np


def random_actions(seed: int, steps: int, size: int) -> np.ndarray:
    """The actions of an episode, (steps, size), float32.

    Uniform for even seeds. Odd seeds add a constant direction, which takes the robot far: to its
    joint limits, the table and itself.
    """
    generator = np.random.default_rng(1000 + seed)
    actions = generator.uniform(-1.0, 1.0, (steps, size))
    if seed % 2:
        actions = np.clip(0.5 * actions + generator.uniform(-1.0, 1.0, size), -1.0, 1.0)
    return actions.astype(np.float32)


def play(environment_id: str, seed: int, steps: int, substeps: int) -> dict[str, np.ndarray]:
    """One episode in a fresh instance: arrays with a leading axis of steps + 1 (step 0: reset)."""
    # Fetch environments do not let the number of substeps be chosen.
    options = {} if substeps == 20 else {'n_substeps': substeps}
    env = gymnasium.make(environment_id, max_episode_steps=steps + 1, **options).unwrapped
    observation, _ = env.reset(seed=seed)
    rows = [observation | {'sparse': 0.0, 'dense': 0.0, 'is_success': 0.0}]
    for action in random_actions(seed, steps, env.action_space.shape[0]):
        observation, sparse, _, _, info = env.step(action)
        env.reward_type = 'dense'
        dense = env.compute_reward(observation['achieved_goal'], observation['desired_goal'], info)
        env.reward_type = 'sparse'
        reward = {'sparse': sparse, 'dense': dense, 'is_success': info['is_success']}
        rows.append({name: np.copy(value) for name, value in (observation | reward).items()})
    env.close()
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def main() -> None:
    """Writes arrays (seeds, steps + 1, ...)."""
    environment_id, seeds, steps, substeps, path = sys.argv[1:]
    warnings.simplefilter('ignore')
    import gymnasium_robotics  # Slow, and the tests import this module for the actions.

    gymnasium.register_envs(gymnasium_robotics)
    episodes = [play(environment_id, seed, int(steps), int(substeps)) for seed in range(int(seeds))]
    np.savez(path, **{name: np.stack([e[name] for e in episodes]) for name in episodes[0]})


if __name__ == '__main__':
    main()
