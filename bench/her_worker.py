"""Trains one competitor of `bench_her.py` on one task until a success or a time limit.

Each line it prints is one evaluation as JSON: seconds, env_steps, success. The clock stands still
while an evaluation runs, for all competitors alike. All train on this project's simulation.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import torch

from fetch_hand_sim.simulation import Simulation
from policy_node.policies.policy import Policy
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.evaluation import FIRST_SEED, evaluate
from policy_node.training.runs.run_folder import RunFolder
from policy_node.training.runs.trainer import Trainer

# Without end: the limit in seconds or the target ends a run.
ENDLESS = 10**12
FUTURE_4 = {'goal_selection_strategy': 'future', 'n_sampled_goal': 4}
# rl-baselines3-zoo, hyperparams/tqc.yml, FetchPush and FetchPickAndPlace; one environment.
ZOO_TQC = {
    'batch_size': 2048,
    'gamma': 0.95,
    'learning_rate': 1e-3,
    'tau': 0.05,
    'policy_kwargs': {'net_arch': [512, 512, 512], 'n_critics': 2},
}
# VladPrytula/robotics_series, chapters 4 and 5: best of 24 settings on FetchPush-v4.
TUNED_SAC = {'gamma': 0.95, 'ent_coef': 0.05, 'learning_starts': 1000}
SAC_ENVS = 8


class Examiner:
    """Measures training time, evaluates at intervals and decides when to stop."""

    def __init__(self, options: argparse.Namespace) -> None:
        self._options = options
        self._simulation = Simulation(
            options.task, num_envs=options.episodes, num_threads=options.threads
        )
        self._next = options.evaluate_every
        self._paused = 0.0
        self._started = time.monotonic()

    def start(self) -> None:
        """Starts the clock: the first environment step comes now."""
        self._started = time.monotonic()

    def done(self, env_steps: int, policy: Callable[[], Policy]) -> bool:
        """Evaluates if it is time to; True once the target or the limit is reached."""
        seconds = time.monotonic() - self._started - self._paused
        late = seconds >= self._options.limit
        if env_steps < self._next and not late:
            return False
        before = time.monotonic()
        self._next = env_steps + self._options.evaluate_every
        outcomes = evaluate(self._simulation, policy(), self._options.episodes, FIRST_SEED)
        success = float(outcomes.success_gymnasium.mean())
        row = {'seconds': round(seconds, 2), 'env_steps': env_steps, 'success': success}
        print(json.dumps(row), flush=True)
        self._paused += time.monotonic() - before
        return late or success >= self._options.target


def train_this_project(options: argparse.Namespace) -> None:
    """The `best` recipe; collection overlaps with learning where there are two threads for it."""
    half = max(options.threads // 2, 1)
    config = recipe_config(
        options.task,
        'best',
        seed=options.seed,
        overlap=options.threads > 1,
        simulation_threads=half,
        torch_threads=max(options.threads - half, 1),
        # The examiner evaluates.
        evaluate_every=ENDLESS,
        evaluation_episodes=1,
        checkpoint_seconds=ENDLESS,
    )
    examiner = Examiner(options)
    with tempfile.TemporaryDirectory() as output:
        trainer = Trainer(RunFolder(Path(output), config))

        class CycleLog:
            def write(self, row: dict[str, Any]) -> None:
                del row
                if examiner.done(trainer.counters.env_steps, trainer.learner.evaluation_actor):
                    trainer.stop('done')

        examiner.start()
        trainer.train(CycleLog())


def train_stable_baselines3(options: argparse.Namespace) -> None:
    """Hindsight replay of Stable-Baselines3 with TQC or SAC."""
    from stable_baselines3 import SAC, HerReplayBuffer
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.env_util import make_vec_env

    examiner = Examiner(options)

    class ExaminerCallback(BaseCallback):
        def _on_step(self) -> bool:
            return not examiner.done(self.num_timesteps, lambda: self.model)

    is_tqc = options.competitor == 'sb3_tqc'
    algorithm, settings = SAC, TUNED_SAC
    if is_tqc:
        from sb3_contrib import TQC

        algorithm, settings = TQC, ZOO_TQC
    name = f'fetch_hand_sim:fetch_hand_sim/{options.task}-v0'
    environment = make_vec_env(lambda: gymnasium.make(name), 1 if is_tqc else SAC_ENVS)
    model = algorithm(
        'MultiInputPolicy',
        environment,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs=FUTURE_4,
        seed=options.seed,
        **settings,
    )
    examiner.start()
    model.learn(ENDLESS, callback=ExaminerCallback())


COMPETITORS = {
    'this_project': train_this_project,
    'sb3_tqc': train_stable_baselines3,
    'sb3_sac': train_stable_baselines3,
}


def main() -> None:
    """Train one competitor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument('competitor', choices=COMPETITORS)
    parser.add_argument('task')
    parser.add_argument('--limit', type=float, required=True)
    parser.add_argument('--target', type=float, required=True)
    parser.add_argument('--episodes', type=int, required=True)
    parser.add_argument('--evaluate-every', type=int, required=True)
    parser.add_argument('--threads', type=int, required=True)
    parser.add_argument('--seed', type=int, required=True)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    COMPETITORS[options.competitor](options)


if __name__ == '__main__':
    main()
