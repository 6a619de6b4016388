"""Steps per second of Stable-Baselines3's SAC+HER on three vectorisations of one task.

Usage: python -O bench/bench_sb3_vec_env.py [--task FetchPush] [--num-envs 8] [--steps 6000]

`-O` is for Gymnasium-Robotics, whose Fetch environments fail their own assertion on MuJoCo 4.
Prints a table: all steps of `learn`, with one update of the networks per step of all environments.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import gymnasium
import gymnasium_robotics
import torch
from stable_baselines3 import SAC, HerReplayBuffer
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecMonitor

from fetch_hand_sim.gym_envs.registration import environment_id
from fetch_hand_sim.gym_envs.stable_baselines3 import FetchHandVecEnv
from msgs_spec.tasks import TASKS


def singles(name: str, num_envs: int) -> VecEnv:
    """Stable-Baselines3's own vectorisation."""
    return DummyVecEnv([lambda: gymnasium.make(name)] * num_envs)


def steps_per_second(env: VecEnv, steps: int, updates: bool) -> float:
    """Plays `steps` in all, after a warm-up, with and without learning."""
    warm_up = 10 * 50 * env.num_envs // 4
    model = SAC(
        'MultiInputPolicy',
        VecMonitor(env),
        replay_buffer_class=HerReplayBuffer,
        policy_kwargs={'net_arch': [256, 256]},
        learning_starts=warm_up if updates else warm_up + steps + env.num_envs,
        batch_size=256,
        device='cpu',
        seed=0,
    )
    model.learn(warm_up)
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return steps / (time.perf_counter() - start)


def main() -> None:
    """Measures each vectorisation, with and without updates."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('--task', choices=TASKS, default='FetchPush')
    parser.add_argument('--num-envs', type=int, default=8)
    parser.add_argument('--steps', type=int, default=6000)
    args = parser.parse_args()
    gymnasium.register_envs(gymnasium_robotics)
    torch.set_num_threads(1)
    ours = environment_id(args.task)
    makers: dict[str, Callable[[], VecEnv]] = {
        'Gymnasium-Robotics, DummyVecEnv': lambda: singles(
            TASKS[args.task].reference_id, args.num_envs
        ),
        'fetch_hand_sim, DummyVecEnv': lambda: singles(ours, args.num_envs),
        'fetch_hand_sim, FetchHandVecEnv': lambda: FetchHandVecEnv(args.task, args.num_envs),
    }
    print('| environments | steps/s, learning | steps/s, random actions |')
    print('|---|---|---|')
    for name, make in makers.items():
        rates = [steps_per_second(make(), args.steps, updates) for updates in (True, False)]
        print(f'| {name} | {rates[0]:,.0f} | {rates[1]:,.0f} |', flush=True)


main()
