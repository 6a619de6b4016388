"""Plays episodes of random actions in one implementation, block by block, and takes the time.

Started by `bench_sim.py`, in the environment that has the implementation. Every line on standard
input is a number of steps to play; the answer is one line of JSON.

Usage: python sim_worker.py <implementation> <task> <reference id> <simulations> <threads> <file>
"""

from __future__ import annotations

import json
import os
import sys
import time
import warnings
from collections.abc import Callable
from typing import Any

import numpy as np

# Distinct batches of random actions, played in turn.
ACTION_BATCHES = 50

Times = dict[str, float]


class VectorWorker:
    """Any `gymnasium.vector.VectorEnv` with next-step autoreset, in which all episodes end at once.

    The step that ends an episode is followed by one that only resets; the two are timed apart.
    """

    def __init__(self, env: Any, num_envs: int, repeats: int = 1) -> None:
        self._env = env
        self._num_envs = num_envs
        self._repeats = repeats
        env.reset(seed=list(range(num_envs)))
        size = env.action_space.shape[-1]
        generator = np.random.default_rng(0)
        shape = (ACTION_BATCHES, num_envs, size)
        self._actions = generator.uniform(-1.0, 1.0, shape).astype(np.float32)

    def play(self, steps: int) -> Times:
        """Plays a block of steps, and the resets after the episodes that end in it."""
        seconds = reset_seconds = 0.0
        for step in range(steps * self._repeats):
            start = time.perf_counter()
            ended = np.all(self._env.step(self._actions[step % ACTION_BATCHES])[3])
            end = time.perf_counter()
            seconds += end - start
            if ended:
                self._env.step(self._actions[0])
                reset_seconds += time.perf_counter() - end
        played = steps * self._repeats * self._num_envs
        return {'steps': played, 'seconds': seconds, 'reset_seconds': reset_seconds}


class PhysicsWorker:
    """`Batch.step` alone, from the very states and actions of a recorded episode."""

    def __init__(self, batch: Any, states: np.ndarray) -> None:
        self._batch = batch
        self._states = states
        self._next = 0

    def play(self, steps: int) -> Times:
        """The physics of a block of steps; there are no resets."""
        seconds = 0.0
        for _ in range(steps):
            self._batch.state[:] = self._states[self._next]
            self._next = (self._next + 1) % len(self._states)
            start = time.perf_counter()
            self._batch.step(nstep=20)
            seconds += time.perf_counter() - start
        played = steps * self._states.shape[1]
        return {'steps': played, 'seconds': seconds, 'reset_seconds': 0.0}


def record_episode(task: str, num_envs: int) -> tuple[np.ndarray, Any]:
    """States (steps, N, state size) of an episode before each step, and the model."""
    from fetch_hand_sim.simulation import Simulation
    from msgs_spec.robots import command_from_action

    simulation = Simulation(task, num_envs=num_envs)
    simulation.reset(seed=0)
    physics, robot = simulation.task, simulation.spec.robot
    generator = np.random.default_rng(0)
    states = []
    for _ in range(simulation.spec.episode_ticks):
        actions = generator.uniform(-1.0, 1.0, (num_envs, robot.action_size))
        physics.apply_commands(command_from_action(robot, actions))
        states.append(physics.batch.state.copy())
        physics.step()
    return np.array(states), simulation.model


def this_project(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """Our vectorised environment; it also records the episode for `bare_physics`."""
    import gymnasium

    if not os.path.exists(path):
        states, model = record_episode(task, num_envs)
        np.savez(path, states=states, eq_data=model.eq_data)
    env = gymnasium.make_vec(
        f'fetch_hand_sim:fetch_hand_sim/{task}-v0',
        num_envs=num_envs,
        vectorization_mode='vector_entry_point',
        num_threads=threads,
    )
    return VectorWorker(env, num_envs)


def disturbed(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """Our vectorised environment with all groups of disturbances."""
    import fetch_hand_sim

    env = fetch_hand_sim.make_vec(task, num_envs, num_threads=threads, disturbances='hardware')
    return VectorWorker(env, num_envs)


def bare_physics(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """MuJoCo's batch on the model as published; nothing of this project runs."""
    from mujoco.batch import Batch

    from fetch_hand_sim.simulation.models import load_model
    from fetch_hand_sim.simulation.tasks.fetch import FETCH_CONFIGS
    from fetch_hand_sim.simulation.tasks.hand_manipulate import MANIPULATE_CONFIGS

    configs: dict[str, Any] = {**FETCH_CONFIGS, **MANIPULATE_CONFIGS}
    model = load_model(configs[task].asset if task in configs else 'hand/reach.xml')
    with np.load(path) as recorded:
        model.eq_data[:] = recorded['eq_data']
        return PhysicsWorker(Batch(model, num_envs, threads), recorded['states'])


def tuned_physics(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """MuJoCo's batch on the model and with the settings of this project."""
    from mujoco.batch import Batch

    from fetch_hand_sim.simulation import Simulation

    model = Simulation(task).model
    with np.load(path) as recorded:
        return PhysicsWorker(Batch(model, num_envs, threads), recorded['states'])


def envpool(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """EnvPool's C++ environments, synchronous."""
    import envpool as peer

    env = peer.make_gymnasium(reference_id, num_envs=num_envs, num_threads=threads, seed=0)
    return VectorWorker(env, num_envs)


def gymnasium_robotics(task: str, reference_id: str, num_envs: int, threads: int, path: str) -> Any:
    """Gymnasium-Robotics: one process with one environment, or one process per environment."""
    import gymnasium
    import gymnasium_robotics as peer

    gymnasium.register_envs(peer)
    if threads == 1:
        env = gymnasium.vector.SyncVectorEnv([lambda: gymnasium.make(reference_id)])
        return VectorWorker(env, 1, repeats=8)
    env = gymnasium.vector.AsyncVectorEnv([lambda: gymnasium.make(reference_id)] * num_envs)
    return VectorWorker(env, num_envs)


WORKERS: dict[str, Callable[..., Any]] = {
    worker.__name__: worker
    for worker in (
        this_project,
        disturbed,
        bare_physics,
        tuned_physics,
        envpool,
        gymnasium_robotics,
    )
}


def main() -> None:
    """Answers requests until standard input ends."""
    warnings.simplefilter('ignore')
    answers = os.fdopen(os.dup(1), 'w')
    os.dup2(2, 1)  # Keeps the output of the peers out of the answers.
    implementation, task, reference_id, num_envs, threads, path = sys.argv[1:]
    worker = WORKERS[implementation](task, reference_id, int(num_envs), int(threads), path)
    print(json.dumps({'ready': implementation}), file=answers, flush=True)
    for request in sys.stdin:
        print(json.dumps(worker.play(int(request))), file=answers, flush=True)


if __name__ == '__main__':
    main()
