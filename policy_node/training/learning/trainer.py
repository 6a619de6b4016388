"""The training loop: collect, learn, evaluate, keep the best."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from fetch_hand_sim.simulation import Simulation
from fetch_hand_sim.simulation.rewards import GoalMetric
from msgs_spec.command_line import complain
from policy_node.policies.actor import Actor
from policy_node.training.evaluation.episodes import EpisodeOutcomes, diagnose
from policy_node.training.evaluation.evaluator import EVALUATION_SEED, Evaluator
from policy_node.training.learning.collector import Collector
from policy_node.training.learning.config import TrainConfig
from policy_node.training.learning.ddpg import DDPG, Losses, choose_device
from policy_node.training.learning.distributed import Workers
from policy_node.training.learning.experience import Experience
from policy_node.training.learning.initial_networks import (
    CRITIC_FIRST,
    InitialNetworks,
    network_shape,
)
from policy_node.training.learning.replay import Episodes
from policy_node.training.learning.replay_file import load_replay, save_replay
from policy_node.training.learning.run_folder import BEST_FILE, LATEST_FILE, RunFolder
from policy_node.training.learning.run_log import RunLog
from policy_node.training.learning.threads import split_threads
from policy_node.training.learning.training_state import Counters, load_networks, load_state

NAME = 'train_her'
# Seconds between copies of the newest episodes beside the training state.
REPLAY_SECONDS = 900.0
# Steps that a resumed run without these episodes collects before it goes on.
MOST_REFILLED = 100_000


class TrainingError(RuntimeError):
    """Training cannot go on; the message names the step and the cause."""


@dataclass(frozen=True, slots=True)
class Collected:
    """What one cycle of collection, and the evaluation when one was due, gave."""

    episodes: Episodes
    train_success: float
    evaluation: EpisodeOutcomes | None
    evaluated: Actor | None


class Trainer:
    """One run of one configuration, on one of several workers."""

    def __init__(
        self,
        config: TrainConfig,
        output: Path,
        workers: Workers,
        command: str = '',
        source_revision: str = '',
        init_from: InitialNetworks | None = None,
    ) -> None:
        """Prepares simulations, networks and the output folder.

        Args:
            config: What to train and how.
            output: Folder for checkpoints and logs.
            workers: This worker among all.
            command: Command line, for the metadata of checkpoints.
            source_revision: Revision of the source, likewise.
            init_from: Networks to start from; None starts from random ones.
        """
        self.config = config
        self.workers = workers
        origin = {} if init_from is None else init_from.origin
        self._folder = RunFolder(output, config, command, source_revision, origin)
        self.device = choose_device(config.device)
        self._simulation_threads, torch_threads = split_threads(config)
        torch.set_num_threads(torch_threads)
        torch.manual_seed(config.seed)
        self._build_simulations()
        self._build_learner()
        if init_from is not None:
            load_networks(init_from.tensors, self.learner, self.experience.statistics)
            self._let_critic_learn_first()
        self.counters = Counters()
        self._stop_reason = ''
        self._refill = 0
        self._last_checkpoint = self._last_replay = time.monotonic()

    def _build_simulations(self) -> None:
        config, share = self.config, self.workers.share
        options: dict[str, Any] = {
            'num_threads': self._simulation_threads,
            'reward_type': config.reward_type,
            'success_rule': config.success_rule,
            'control_hz': config.control_hz,
        }
        num_envs = share(config.num_envs)
        self.simulation = Simulation(config.task, num_envs=num_envs, **options)
        count = min(num_envs, config.evaluation_episodes)
        self._evaluator = Evaluator(Simulation(config.task, num_envs=count, **options), config)
        self.spec = self.simulation.spec

    def _seed(self, env_steps: int) -> np.random.Generator:
        """Seeds resets and exploration from `env_steps` on; returns the generator of batches."""
        config = self.config
        seeds = np.random.SeedSequence([config.seed, self.workers.rank, env_steps])
        collector_seeds, sampler_seed = seeds.spawn(2)
        # Below the seeds of evaluation, whose episodes must stay unseen.
        resets = collector_seeds.generate_state(self.simulation.num_envs) >> 2
        self.collector = Collector(
            self.simulation,
            [int(seed) % EVALUATION_SEED for seed in resets],
            config.noise_std,
            config.random_epsilon,
            config.noise_spread,
        )
        return np.random.default_rng(sampler_seed)

    def _build_learner(self) -> None:
        config, spec = self.config, self.spec
        self.learner = DDPG(network_shape(config), config, self.device, self.workers)
        shares = config.reward_distance, config.reward_rotation
        compute_reward = scale_thresholds(self.simulation.metric, *shares).reward
        generator = self._seed(env_steps=0)
        self.experience = Experience(config, spec, self.workers, compute_reward, generator)

    def stop(self, reason: str) -> None:
        """Asks the run to end after the current cycle, with a checkpoint."""
        self._stop_reason = reason

    def resume(self, path: Path) -> None:
        """Continues from a training state and the episodes beside it.

        Where these are missing, as many are collected before learning goes on; they do not count as
        steps of the run.

        Raises:
            ValueError: If the file does not fit the configuration.
        """
        state = load_state(path, self.learner, self.experience.statistics)
        self.counters = state.counters
        self._folder = replace(self._folder, init_from=state.extra.get('init_from', {}))
        self._let_critic_learn_first()
        # Simulations are not part of the state: fresh seeds, so that no episode comes twice.
        self.experience.generator = self._seed(self.counters.env_steps)
        limits = (self.counters.env_steps, self.config.replay_transitions, MOST_REFILLED)
        self._refill = self.workers.share(min(limits))
        file = self._folder.replay_file(self.workers.rank)
        try:
            load_replay(file, self.experience.replay)
        except ValueError as error:
            if file.exists():
                complain(NAME, error)
            complain(NAME, f'{self._refill:,} steps fill the replay before learning goes on')

    def _let_critic_learn_first(self) -> None:
        """Holds an actor back that began without its critic."""
        if not self._folder.init_from.get('critic', True) and self.config.critic_first == 0:
            self.learner.critic_first = CRITIC_FIRST

    def add_experience(self, episodes: Episodes) -> None:
        """Puts episodes from elsewhere into the replay; each worker takes its share.

        They do not count as environment steps. Normalisers learn from them too, unless the run was
        resumed and so may have seen them.

        Raises:
            ValueError: If they do not fit into the replay.
        """
        rows = np.arange(len(episodes)) % self.workers.world_size == self.workers.rank
        share = episodes.select(rows)
        self.experience.replay.add(share)
        if self.counters.env_steps == 0:
            self.experience.normalize(share, self.learner.actor, env_steps=0)

    def train(self, log: RunLog | None = None) -> str:
        """Runs until a limit is reached or `stop` is called; returns why it ended.

        Raises:
            TrainingError: If a loss or an observation is not finite; the checkpoints written before
                are left as they are.
        """
        if self.counters.env_steps >= self.config.total_steps:
            return f'{self.config.total_steps:,} environment steps were done before'
        started = time.monotonic() - self.counters.seconds
        # The number of tensor threads belongs to a thread: without its own, the collector's small
        # products would start one per core, which then spin against the simulation and the learner.
        with ThreadPoolExecutor(1, 'collector', torch.set_num_threads, (1,)) as executor:
            submit = executor.submit if self.config.overlap else _run_now
            collected = self._collect_first(submit)
            while True:
                before = time.monotonic()
                self._absorb(collected)
                job = submit(self._collect, *self._request()) if self.config.overlap else None
                losses = self._learn()
                if job is None:
                    job = submit(self._collect, *self._request())
                collected = self._collect_or_explain(job)
                self.counters.seconds = time.monotonic() - started
                self._check(losses)
                self._keep_best(collected)
                if log is not None:
                    log.write(self._row(collected, losses, time.monotonic() - before))
                reason = self._reason_to_stop(collected)
                if reason:
                    self.save()
                elif self._checkpoint_due():
                    self._save_or_complain()
                if reason:
                    return reason

    def _collect_first(self, submit: Callable[..., Future[Collected]]) -> Collected:
        """Fills the replay of a resumed run that has lost it, then collects the first cycle."""
        while True:
            actor, random, _ = self._request(may_evaluate=False)
            collected = self._collect_or_explain(submit(self._collect, actor, random, None))
            filled = self.experience.transitions >= self._refill
            if not self.workers.any(not filled and not self._stop_reason):
                return collected
            self.experience.replay.add(collected.episodes)

    def _request(self, may_evaluate: bool = True) -> tuple[Actor, bool, Actor | None]:
        """What to collect next: with which actor, whether at random, and which to evaluate."""
        counters, steps = self.counters, self.counters.env_steps
        self.collector.exploration = self._exploration()
        actor, evaluated = copy.deepcopy(self.learner.actor).cpu().eval(), None
        if may_evaluate and counters.updates > 0 and steps >= counters.next_evaluation:
            counters.next_evaluation = steps + self.config.evaluate_every
            if self.workers.is_first:
                evaluated = self.learner.evaluation_actor()
        return actor, steps < self.config.random_steps, evaluated

    def _collect(self, actor: Actor, random: bool, evaluated: Actor | None) -> Collected:
        outcomes = None
        if evaluated is not None:
            outcomes = self._evaluator.evaluate(evaluated, self.counters.best_success)
        episodes, success = self.collector.collect(actor, random)
        return Collected(episodes, success, outcomes, evaluated)

    def _exploration(self) -> float:
        """Share of noise and random actions for a run as far as this one."""
        left = 3.0 * (1.0 - self.counters.env_steps / self.config.total_steps)
        final = self.config.final_exploration
        return final + (1.0 - final) * min(max(left, 0.0), 1.0)

    def _collect_or_explain(self, job: Future[Collected]) -> Collected:
        collected = job.result()
        for name in ('observation', 'achieved_goal', 'desired_goal', 'action'):
            if not np.isfinite(getattr(collected.episodes, name)).all():
                raise TrainingError(
                    f'{name} is not finite after {self.counters.env_steps} environment steps'
                )
        return collected

    def _absorb(self, collected: Collected) -> None:
        """Puts new episodes into the replay and into the normalisers."""
        episodes = collected.episodes
        if len(episodes):
            self.experience.replay.add(episodes)
        count = self.workers.sum(torch.tensor([len(episodes)])).item()
        self.counters.episodes += int(count)
        self.counters.env_steps += int(count) * self.spec.episode_ticks
        self.experience.normalize(episodes, self.learner.actor, self.counters.env_steps)

    def _learn(self) -> list[Losses]:
        first = self.workers.share(self.config.learning_starts) if self.counters.updates == 0 else 0
        if self.workers.any(self.experience.transitions < max(first, 1)):
            return []
        steps = self.counters.env_steps
        self.learner.set_progress(steps / self.config.total_steps)
        losses = [
            self.learner.update(self.experience.batch(steps))
            for _ in range(self.config.updates_per_cycle)
        ]
        self.learner.average()
        self.counters.updates = self.learner.updates
        return losses

    def _check(self, losses: list[Losses]) -> None:
        """Stops on the first loss that is not finite."""
        first = self.counters.updates - len(losses)
        for name in ('critic', 'actor'):
            values = [getattr(loss, name) for loss in losses]
            finite = torch.isfinite(torch.stack(values)).tolist() if values else []
            if not all(finite):
                update = first + finite.index(False) + 1
                raise TrainingError(
                    f'{name} loss is {float(values[finite.index(False)])} in update {update}, '
                    f'after {self.counters.env_steps} environment steps'
                )

    def _keep_best(self, collected: Collected) -> None:
        """Saves the evaluated actor if it succeeds more often, or as often and sooner."""
        outcomes, actor, counters = collected.evaluation, collected.evaluated, self.counters
        if outcomes is None or actor is None or not self._evaluator.is_complete(outcomes):
            return
        success = self._evaluator.success_rate(outcomes)
        mean_return = float(outcomes.episode_return.mean())
        if (success, mean_return) > (counters.best_success, counters.best_return):
            counters.best_success, counters.best_return = success, mean_return
            if self.workers.is_first:
                rule = self.config.success_rule
                measured = {'last_step': success, 'episodes': len(outcomes), 'rule': rule}
                measured |= diagnose(outcomes)
                self._folder.save_actor(BEST_FILE, actor, counters.env_steps, measured)

    def _reason_to_stop(self, collected: Collected) -> str:
        config, reason = self.config, self._stop_reason
        target = config.success_target
        if not reason and 0 < target <= self.counters.best_success:
            reason = f'success target {target:g} reached'
        if not reason and self.counters.env_steps >= config.total_steps:
            reason = f'{config.total_steps:,} environment steps done'
        if not reason and 0 < config.time_limit <= self.counters.seconds:
            reason = f'time limit of {config.time_limit:g} s reached'
        return (reason or 'another worker stopped') if self.workers.any(bool(reason)) else ''

    def _checkpoint_due(self) -> bool:
        elapsed = time.monotonic() - self._last_checkpoint
        return elapsed >= self.config.checkpoint_seconds

    def _save_or_complain(self) -> None:
        """Writes a checkpoint on the way, the replay only now and then; a full disk may empty."""
        try:
            self.save(time.monotonic() - self._last_replay >= REPLAY_SECONDS)
        except OSError as error:
            complain(NAME, f'no checkpoint, the one before is kept: {error}')

    def save(self, with_replay: bool = True) -> None:
        """Writes the newest episodes and, as worker 0, the latest actor and the training state.

        Raises:
            OSError: If there is no room for them; what was there before is kept.
        """
        self._last_checkpoint = time.monotonic()
        if with_replay:
            self._last_replay = self._last_checkpoint
            kept = self.workers.share(self.config.kept_transitions)
            file = self._folder.replay_file(self.workers.rank)
            save_replay(file, self.experience.replay, kept)
        if self.workers.is_first:
            self._folder.save_actor(LATEST_FILE, self.learner.actor, self.counters.env_steps)
            self._folder.save_state(self.learner, self.experience.statistics, self.counters)

    def _row(
        self, collected: Collected, losses: list[Losses], seconds: float
    ) -> dict[str, float | None]:
        counters, outcomes = self.counters, collected.evaluation
        samples = len(losses) * self.experience.batch_size * self.workers.world_size
        steps = self.simulation.num_envs * self.spec.episode_ticks * self.workers.world_size

        def mean(name: str) -> float | None:
            return float(torch.stack([getattr(x, name) for x in losses]).mean()) if losses else None

        return {
            'seconds': counters.seconds,
            'env_steps': counters.env_steps,
            'episodes': counters.episodes,
            'updates': counters.updates,
            'train_success': collected.train_success,
            'eval_success': None if outcomes is None else self._evaluator.success_rate(outcomes),
            'eval_episodes': None if outcomes is None else len(outcomes),
            **_diagnostics(outcomes),
            'critic_loss': mean('critic'),
            'actor_loss': mean('actor'),
            'mean_value': mean('value'),
            'steps_per_second': steps / seconds,
            'samples_per_second': samples / seconds,
        }


def _diagnostics(outcomes: EpisodeOutcomes | None) -> dict[str, float | None]:
    """Columns of the log that say why evaluated episodes failed."""
    if outcomes is None:
        return {}
    found = {'touched': float(outcomes.touched.mean()), **diagnose(outcomes)}
    return {f'eval_{name}': value for name, value in found.items() if name != 'long_way_share'}


def scale_thresholds(metric: GoalMetric, distance: float, rotation: float) -> GoalMetric:
    """A metric with these shares of the success distance and rotation of `metric`."""
    spec = replace(metric.spec, distance_threshold=metric.spec.distance_threshold * distance)
    if spec.rotation_threshold is not None:
        spec = replace(spec, rotation_threshold=spec.rotation_threshold * rotation)
    return replace(metric, spec=spec)


def _run_now(function: Callable[..., Collected], *arguments: Any) -> Future[Collected]:
    """Runs a job at once, in this thread, behind the interface of an executor."""
    future: Future[Collected] = Future()
    future.set_result(function(*arguments))
    return future
