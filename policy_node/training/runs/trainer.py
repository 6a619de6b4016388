"""The training loop.

One cycle (`Trainer._run_cycle`) in steps: collect episodes (`collector.collect`), store them
(`replay.add`, `experience.normalize`), draw batches with relabelled goals (`experience.batch`),
learn (`learner.update`), evaluate (`evaluation.evaluate`) and keep the best actor.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import nn

from fetch_hand_sim.simulation import Simulation
from msgs_spec.tasks import task_spec
from node_runtime.command_line import complain
from policy_node.policies.actor import Actor
from policy_node.policies.policy import Policy
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.evaluation import (
    EVALUATION_SEED,
    EpisodeOutcomes,
    evaluate,
    success_rate,
    training_seeds,
    wilson_interval,
)
from policy_node.training.experience.episode_files import load_replay
from policy_node.training.experience.replay import Episodes
from policy_node.training.learners.actor_critic import Losses
from policy_node.training.machine import choose_device, split_threads
from policy_node.training.research.registry import (
    make_collector,
    make_learner,
    make_simulation,
)
from policy_node.training.runs.initial_networks import CRITIC_FIRST, InitialNetworks
from policy_node.training.runs.run_folder import NAME, RunFolder
from policy_node.training.runs.run_log import Row, RunLog, evaluation_columns, loss_columns
from policy_node.training.runs.training_state import (
    Counters,
    RunClock,
    fitting,
    load_networks,
    load_state,
    require_finite,
    require_readable,
)

Candidate = tuple[Actor, dict[str, Policy]]
"""An actor to evaluate, and policies beside it by column of `progress.csv`."""

# Largest number of steps that a resumed run without its replay collects before it learns.
MOST_REFILLED = 100_000


@dataclass(frozen=True, slots=True)
class Collected:
    """The episodes of one cycle, with the evaluation if one was due.

    Attributes:
        train_success: Success rate of these episodes, with exploration noise.
        evaluation: Outcomes of the evaluation; None if none was due.
        evaluated: The evaluated actor; None without an evaluation.
        others: Success rates of further policies, by column of `progress.csv`.
    """

    episodes: Episodes
    train_success: float
    evaluation: EpisodeOutcomes | None = None
    evaluated: Actor | None = None
    others: dict[str, float] = field(default_factory=dict)


class BaseTrainer:
    """Base class of trainers. It evaluates policies, counts steps and decides when a run ends.

    Args:
        folder: Folder of the run, with its configuration and this worker.
        init_from: Networks to start from; None starts from random ones.
    """

    def __init__(self, folder: RunFolder, init_from: InitialNetworks | None = None) -> None:
        self.folder, self.counters = folder, Counters()
        self.config, self.workers = config, workers = folder.config, folder.workers
        folder.init_from = {} if init_from is None else init_from.origin
        self._threads, torch_threads = split_threads(config)
        torch.set_num_threads(torch_threads)
        torch.manual_seed(config.seed)
        count = min(workers.share(config.num_envs), config.evaluation_episodes)
        # In simulations of its own, an evaluation does not change the episodes of training.
        self._evaluated = self._simulate(config, count)
        self.spec = task_spec(config.task, control_hz=config.control_hz)
        self._stop_reason = ''

    def _simulate(self, config: TrainConfig, count: int) -> Simulation:
        return make_simulation(config, count, self._threads)

    def _progress(self) -> float:
        """Return the share of the run that is done, 0 ... 1."""
        return self.counters.env_steps / self.config.total_steps

    def stop(self, reason: str) -> None:
        """End the run with a checkpoint after the current cycle; `train` then returns `reason`."""
        self._stop_reason = reason

    def _reason_to_stop(self) -> str:
        reason = self._stop_reason or (self._ended() or ('', ''))[1]
        return (reason or 'another worker stopped') if self.workers.any(bool(reason)) else ''

    def _ended(self) -> tuple[str, str] | None:
        """Return the reached limit as (name of its `TrainConfig` field, message), or None."""
        config, counters = self.config, self.counters
        if 0 < config.success_target <= counters.best_success:
            return 'success_target', f'success target {config.success_target:g} reached'
        if counters.env_steps >= config.total_steps:
            return 'total_steps', f'{counters.env_steps:,} environment steps done'
        if 0 < config.time_limit <= counters.seconds:
            return 'time_limit', f'time limit of {config.time_limit:g} s reached'
        return None

    def _outcomes(self, policy: Policy, to_beat: float = -1.0) -> EpisodeOutcomes:
        """Evaluate a policy on the same episodes each time.

        The evaluation ends early once the 95 % interval of the success rate of `policy` lies below
        `to_beat`; the default never ends it early.
        """
        rule = self.config.success_rule

        def is_hopeless(outcomes: EpisodeOutcomes) -> bool:
            count = len(outcomes)
            successes = round(success_rate(outcomes, rule) * count)
            return wilson_interval(successes, count)[1] < to_beat

        episodes = self.config.evaluation_episodes
        return evaluate(self._evaluated, policy, episodes, EVALUATION_SEED, is_hopeless)

    def _row(
        self, train_success: float, outcomes: EpisodeOutcomes | None, samples: int, seconds: float
    ) -> Row:
        """Return the row of a cycle for `progress.csv`.

        Args:
            train_success: Success rate of the collected episodes.
            outcomes: The evaluation; None if none was due.
            samples: Number of transitions learnt from, over all workers.
            seconds: Wall-clock time of the cycle.
        """
        counters, workers = self.counters, self.workers
        steps = workers.share(self.config.num_envs) * self.spec.episode_ticks * workers.world_size
        return {
            'seconds': counters.seconds,
            'env_steps': counters.env_steps,
            'episodes': counters.episodes,
            'updates': counters.updates,
            'train_success': train_success,
            'processor_seconds': counters.processor_seconds,
            **evaluation_columns(outcomes, self.config.success_rule),
            'steps_per_second': steps / seconds,
            'samples_per_second': samples / seconds,
        }


class Trainer(BaseTrainer):
    """Runs the training loop of one configuration, on one of several workers."""

    def __init__(self, folder: RunFolder, init_from: InitialNetworks | None = None) -> None:
        super().__init__(folder, init_from)
        config, workers = self.config, self.workers
        self.simulation = self._simulate(config, workers.share(config.num_envs))
        device, generator = choose_device(config.device), self._seed(env_steps=0)
        self.learner, self.experience = make_learner(
            config, self.simulation.metric, device, workers, generator
        )
        require_readable(self.learner)
        if init_from is not None:
            with fitting(init_from.origin['name']):
                tensors = init_from.completed(self.learner)
                load_networks(tensors, self.modules())
            self._let_critic_learn_first()
        self._steps_to_refill = 0

    def modules(self) -> dict[str, nn.Module]:
        """Return networks and normalizer statistics by their names in a training state."""
        return {**self.learner.modules, **self.experience.statistics}

    def _seed(self, env_steps: int) -> np.random.Generator:
        """Replace `collector` by a new one; return a random generator for drawing batches.

        The seeds of both depend on the seed of the run, the worker and `env_steps`.
        """
        config = self.config
        seeds = np.random.SeedSequence([config.seed, self.workers.rank, env_steps])
        collector_seeds, sampler_seed = seeds.spawn(2)
        starts = training_seeds(collector_seeds, self.simulation.num_envs)
        self.collector = make_collector(self.simulation, starts, config)
        return np.random.default_rng(sampler_seed)

    def resume(self, path: Path) -> None:
        """Continue from the training state in the file `path` and the replay beside it.

        If the replay is missing or has too few episodes, the run first refills it with new
        episodes, which do not count as environment steps.

        Raises:
            ValueError: If the file does not fit the configuration.
        """
        state = load_state(path, self.learner, self.modules())
        self.counters = counters = state.counters
        # The new configuration may evaluate more often.
        soonest = counters.env_steps + self.config.evaluate_every
        counters.next_evaluation = min(counters.next_evaluation, soonest)
        self.experience.narrow(self._progress())
        self.folder.init_from = state.extra.get('init_from', {})
        self._let_critic_learn_first()
        self.folder.read_best(counters)
        # The state contains no simulations. Use new seeds, so that no episode is repeated.
        self.experience.generator = self._seed(counters.env_steps)
        limits = (counters.env_steps, self.config.replay_transitions, MOST_REFILLED)
        held = self.experience.replay.capacity * self.spec.episode_ticks
        self._steps_to_refill = min(self.workers.share(min(limits)), held)
        file = self.folder.replay_file()
        try:
            load_replay(file, self.experience.replay)
        except ValueError as error:
            if file.exists():
                complain(NAME, error)

    def _let_critic_learn_first(self) -> None:
        """Let only critics learn in the first `CRITIC_FIRST` updates if `init_from` lacks a critic.

        Do nothing if the configuration sets this number itself (`critic_first` is not 0).
        """
        origin = self.folder.init_from
        critics = self.config.critics
        known = origin.get('critics', critics if origin.get('critic', True) else 0)
        if known < critics and self.config.critic_first == 0:
            self.learner.critic_first = CRITIC_FIRST

    def add_experience(self, episodes: Episodes) -> None:
        """Add logged episodes to the replay; each worker takes its share.

        They do not count as environment steps. They are also added to the statistics of the
        normalizers, except in a resumed run, whose statistics may contain them already.

        Raises:
            ValueError: If they do not fit into the replay.
        """
        rows = np.arange(len(episodes)) % self.workers.world_size == self.workers.rank
        share = episodes.select(rows)
        self.experience.replay.add(share)
        if self.counters.env_steps == 0:
            self.experience.normalize(share, self.learner.actor)

    def train(self, log: RunLog | None = None) -> str:
        """Train until a limit is reached or `stop` is called; return the reason in words.

        Raises:
            TrainingError: If a loss, a weight or an observation is not finite. Earlier checkpoints
                stay.
        """
        ended = self._ended()
        if self.workers.any(ended is not None):
            field, reason = ended or ('configuration', 'another worker had ended')
            return f'{reason} before; give another {field} to go on'
        self._clock = RunClock(self.counters)
        with _collecting_thread() as executor:
            collected = self._collect_first(executor)
            if collected is None:
                self.save()
                return self._stop_reason or 'another worker stopped'
            self._warn_of_rewards(collected.episodes)
            while True:
                collected = self._run_cycle(collected, executor, log)
                if reason := self._reason_to_stop():
                    self.save()
                    return reason
                self.folder.save_when_due(self.learner, self.experience, self.counters)

    def _run_cycle(
        self, collected: Collected, executor: ThreadPoolExecutor, log: RunLog | None
    ) -> Collected:
        """Learn from the episodes of one cycle; collect and return the episodes of the next cycle.

        With `overlap`, both happen at the same time.
        """
        before = time.monotonic()
        self._store(collected)
        if self.config.overlap:
            # At the end, evaluate the actor after this cycle, not before it.
            may_evaluate = self._ended() is None
            job = executor.submit(self._collect, *self._prepare_collection(may_evaluate))
            losses = self._learn()
        else:
            losses = self._learn()
            job = executor.submit(self._collect, *self._prepare_collection())
        collected = self._finished(job)
        self._clock.update()
        is_trained = self.counters.updates > 0 or bool(self.config.init_from)
        if collected.evaluation is None and is_trained and self._ended():
            # Evaluate the last actor.
            collected = executor.submit(self._evaluate, collected, self._candidate()).result()
        outcomes, actor = collected.evaluation, collected.evaluated
        if outcomes and actor:
            self.folder.keep_best(outcomes, actor, self.counters)
        if log is not None:
            samples = len(losses) * self.experience.batch_size * self.workers.world_size
            success, seconds = collected.train_success, time.monotonic() - before
            row = self._row(success, outcomes, samples, seconds)
            log.write({**row, **loss_columns(losses), **collected.others})
        return collected

    def _warn_of_rewards(self, episodes: Episodes) -> None:
        """Warn if rewards of a third-party task exceed 0, because learnt values are at most 0."""
        metric = self.simulation.metric
        if self.config.algorithm == 'ppo' or not metric.has_own_reward:
            return
        achieved = episodes.achieved_goal[:, -1].astype(np.float64)
        rewards = metric.reward(achieved, episodes.desired_goal.astype(np.float64))
        # Without episodes there are no rewards.
        highest = rewards.max(initial=0.0)
        if highest > 0.0 and self.workers.is_first:
            complain(
                NAME,
                f'rewards of {self.spec.name} are up to {highest:g}, but values are clipped to '
                'those of rewards within -1 ... 0. Nothing is learnt from larger rewards.',
            )

    def _collect_first(self, executor: ThreadPoolExecutor) -> Collected | None:
        """Refill the replay of a resumed run if needed; return the first cycle to learn from.

        Refilling collects episodes without learning. Return None if the run is stopped meanwhile.
        """
        missing = self._steps_to_refill - self.experience.transitions
        if missing > 0:
            complain(NAME, f'{missing:,} steps fill the replay before learning continues')
        while True:
            actor, _ = self._prepare_collection(may_evaluate=False)
            collected = self._finished(executor.submit(self._collect, actor, None))
            filled = self.experience.transitions >= self._steps_to_refill
            if not self.workers.any(not filled):
                return collected
            self.experience.replay.add(collected.episodes)
            if self.workers.any(bool(self._stop_reason)):
                return None

    def _prepare_collection(self, may_evaluate: bool = True) -> tuple[Policy, Candidate | None]:
        """Set the exploration noise; return the policy that collects and the one to evaluate.

        The second value, of `_candidate`, is None if no evaluation is due or allowed.
        """
        counters, steps = self.counters, self.counters.env_steps
        self.collector.exploration = self._exploration()
        policy, candidate = self.learner.acting_policy(), None
        if may_evaluate and counters.updates > 0 and steps >= counters.next_evaluation:
            counters.next_evaluation = steps + self.config.evaluate_every
            candidate = self._candidate()
        return policy, candidate

    def _candidate(self) -> Candidate | None:
        """Return the actor to evaluate and other policies; None on all workers but the first.

        Other policies, such as both levels of a hierarchy together, are evaluated only for
        `progress.csv`.
        """
        if not self.workers.is_first:
            return None
        return self.learner.evaluation_actor(), self.learner.other_policies()

    def _collect(self, policy: Policy, candidate: Candidate | None) -> Collected:
        return self._evaluate(Collected(*self.collector.collect(policy)), candidate)

    def _evaluate(self, collected: Collected, candidate: Candidate | None) -> Collected:
        if candidate is None:
            return collected
        actor, others = candidate
        outcomes, rule = self._outcomes(actor, self.counters.best_success), self.config.success_rule
        rates = {name: success_rate(self._outcomes(each), rule) for name, each in others.items()}
        return replace(collected, evaluation=outcomes, evaluated=actor, others=rates)

    def _exploration(self) -> float:
        """Return the present factor on exploration noise and random actions, 0 ... 1."""
        left = 3.0 * (1.0 - self._progress())
        final = self.config.final_exploration
        return final + (1.0 - final) * min(max(left, 0.0), 1.0)

    def _finished(self, job: Future[Collected]) -> Collected:
        collected = job.result()
        require_finite(
            ((n, getattr(collected.episodes, n)) for n in Episodes.__slots__), self.counters
        )
        return collected

    def _store(self, collected: Collected) -> None:
        """Add collected episodes to the replay, the counters and the normalizers."""
        episodes = collected.episodes
        self.experience.replay.add(episodes)
        count = self.workers.sum(torch.tensor([len(episodes)])).item()
        self.counters.episodes += int(count)
        self.counters.env_steps += int(count) * self.spec.episode_ticks
        self.experience.normalize(episodes, self.learner.actor)
        self.experience.narrow(self._progress())

    def _learn(self) -> list[Losses]:
        first = self.workers.share(self.config.learning_starts) if self.counters.updates == 0 else 0
        # The replay holds whole episodes.
        first = min(first, self.experience.replay.capacity * self.spec.episode_ticks)
        if self.workers.any(self.experience.transitions < max(first, 1)):
            return []
        self.learner.set_progress(self._progress())
        losses = [
            self.learner.update(self.experience.batch())
            for _ in range(self.config.updates_per_cycle)
        ]
        self.learner.average()
        self.counters.updates = self.learner.updates
        # Check before acting or saving.
        named = [('critic loss', torch.tensor([each.critic for each in losses]))]
        named += [('actor loss', torch.tensor([each.actor for each in losses]))]
        # The loss before the last step may be finite and the weights after it not.
        for part, module in self.learner.modules.items():
            named += [(f'{part}.{n}', value.cpu()) for n, value in module.state_dict().items()]
        require_finite(named, self.counters)
        return losses

    def save(self) -> None:
        """Write the replay's newest episodes; on the first worker, also actor and training state.

        Raises:
            OSError: If a file cannot be written; the earlier files stay.
        """
        self.folder.save(self.learner, self.experience, self.counters)


@contextmanager
def _collecting_thread() -> Iterator[ThreadPoolExecutor]:
    """Provide an executor with one thread for collection; after Ctrl-C, do not wait for its job."""
    # torch counts threads per thread. With its default, the collector's small products would start
    # one per core, and these would slow down simulation and learner.
    executor = ThreadPoolExecutor(1, 'collector', torch.set_num_threads, (1,))
    is_interrupted = False
    try:
        yield executor
    except KeyboardInterrupt:
        is_interrupted = True
        raise
    finally:
        executor.shutdown(wait=not is_interrupted, cancel_futures=True)
