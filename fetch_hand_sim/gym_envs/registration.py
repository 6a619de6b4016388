"""Registers the thirteen tasks with Gymnasium, as `fetch_hand_sim/<Task>-v0`."""

from __future__ import annotations

import gymnasium

from msgs_spec.tasks import TASKS

NAMESPACE = 'fetch_hand_sim'
VERSION = 0


def environment_id(task: str) -> str:
    """The Gymnasium id of a task, for example `fetch_hand_sim/FetchPush-v0`."""
    return f'{NAMESPACE}/{task}-v{VERSION}'


def register_environments() -> None:
    """Registers what is not registered yet; imports nothing that is slow, such as MuJoCo."""
    for task, spec in TASKS.items():
        if environment_id(task) in gymnasium.registry:
            continue
        gymnasium.register(
            environment_id(task),
            entry_point='fetch_hand_sim.gym_envs.env:FetchHandEnv',
            vector_entry_point='fetch_hand_sim.gym_envs.vector_env:FetchHandVectorEnv',
            max_episode_steps=spec.episode_ticks,
            kwargs={'task': task},
        )
