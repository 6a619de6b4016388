"""A film by Gymnasium's RecordVideo, of the installed environments."""

from __future__ import annotations

import os
import sys
import tempfile
from pathlib import Path

import gymnasium.wrappers.vector

import fetch_hand_sim


def main() -> int:
    """Records two episodes of three steps; returns the exit code."""
    os.environ.setdefault('MUJOCO_GL', 'egl')
    envs = fetch_hand_sim.make_vec(
        'FetchReach', num_envs=2, render_mode='rgb_array', max_episode_steps=3, width=96, height=64
    )
    with tempfile.TemporaryDirectory() as folder:
        envs = gymnasium.wrappers.vector.RecordVideo(
            envs, f'{folder}/films', episode_trigger=lambda episode: True
        )
        envs.reset(seed=0)
        for _ in range(5):
            envs.step(envs.action_space.sample())
        envs.close()
        sizes = {path.name: path.stat().st_size for path in Path(folder).glob('films/*.mp4')}
    print(f'films of RecordVideo, in bytes: {sizes}')
    return 0 if any(sizes.values()) else 1


if __name__ == '__main__':
    sys.exit(main())
