"""When a run writes what: the best actor, and checkpoints to go on from."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from node_runtime.command_line import complain
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.checkpoint import ActorInfo
from policy_node.training.evaluation.episodes import EpisodeOutcomes, diagnose
from policy_node.training.evaluation.evaluator import success_rate
from policy_node.training.experience.experience import Experience
from policy_node.training.experience.replay_file import save_replay
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.machine.distributed import Workers
from policy_node.training.runs.run_folder import BEST_FILE, LATEST_FILE, RunFolder
from policy_node.training.runs.state_checks import is_finite
from policy_node.training.runs.training_state import Counters

NAME = 'fetch_hand_sim train'
# Seconds between copies of the newest episodes beside the training state.
REPLAY_SECONDS = 900.0


class Saver:
    """Writes the files of a run, on one of several workers.

    Args:
        folder: Where they go.
        workers: This worker among all.

    Attributes:
        folder: Where they go.
    """

    def __init__(self, folder: RunFolder, workers: Workers) -> None:
        self.folder = folder
        self._config = folder.config
        self._workers = workers
        self._last_checkpoint = self._last_replay = time.monotonic()

    def keep_best(
        self,
        outcomes: EpisodeOutcomes,
        actor: Actor,
        counters: Counters,
        env_steps: int | None = None,
    ) -> None:
        """Saves an evaluated actor if it succeeds more often, or as often and sooner.

        Args:
            outcomes: Its evaluation.
            actor: The actor.
            counters: How far the run is, with the best evaluation so far.
            env_steps: Environment steps behind the actor; None are those of the run.
        """
        rule = self._config.collect.success_rule
        success = success_rate(outcomes, rule)
        mean_return = float(outcomes.episode_return.mean())
        if (success, mean_return) > (counters.best_success, counters.best_return):
            counters.best_success, counters.best_return = success, mean_return
            if self._workers.is_first:
                measured = {'last_step': success, 'episodes': len(outcomes), 'rule': rule}
                measured |= {'mean_return': mean_return, **diagnose(outcomes)}
                steps = counters.env_steps if env_steps is None else env_steps
                self.folder.save_actor(BEST_FILE, actor, steps, measured)

    def keep_no_worse(self, counters: Counters) -> tuple[Actor, ActorInfo] | None:
        """Lets the best actor in the folder stay, which a killed run may have saved last.

        Where it is gone, damaged or of another task, the next one that is evaluated takes its
        place: a run must not end with a success that no file has. One without a measured return
        decides nothing.

        Returns:
            The best actor where it was measured otherwise than this run measures, by another rule
            or on fewer episodes, so that nothing could be compared with it; else None.
        """
        file = self.folder.path / BEST_FILE
        try:
            if counters.best_success >= 0 and not file.is_file():
                raise ValueError(f'{file} is gone')
            if not file.is_file():
                return None
            actor, info = checkpoint.load(file, self._config.task)
        except ValueError as error:
            self._forget_best(counters, f'{error}; the best actor is looked for anew')
            return None
        if self._is_measured_otherwise(info.success):
            self._forget_best(counters, f'{file} was measured otherwise, and is measured anew')
            return actor, info
        best = self._decided_by(info.success)
        if best is not None:
            known = counters.best_success, counters.best_return
            counters.best_success, counters.best_return = max(known, best)
        return None

    def _forget_best(self, counters: Counters, why: str) -> None:
        if self._workers.is_first:
            complain(NAME, why)
        unknown = Counters()
        counters.best_success, counters.best_return = unknown.best_success, unknown.best_return

    def _is_measured_otherwise(self, found: Mapping[str, Any]) -> bool:
        """Whether evaluations of this run say something else than this one, or say it better."""
        config, episodes = self._config, found.get('episodes')
        fewer = is_finite(episodes) and episodes < config.run.evaluation_episodes
        return (
            fewer or found.get('rule', config.collect.success_rule) != config.collect.success_rule
        )

    def _decided_by(self, found: Mapping[str, Any]) -> tuple[float, float] | None:
        """Success and return of an evaluation as those of this run; None if it was none."""
        names = 'episodes', 'last_step', 'mean_return'
        numbers = [float(found[name]) for name in names if is_finite(found.get(name))]
        if 'rule' not in found or len(numbers) < len(names):
            return None
        _, success, mean_return = numbers
        return (success, mean_return) if 0.0 <= success <= 1.0 else None

    def save_when_due(
        self, learner: ActorCritic, experience: Experience, counters: Counters
    ) -> None:
        """Writes a checkpoint now and then, the replay more seldom; a full disk may empty."""
        now = time.monotonic()
        if now - self._last_checkpoint < self._config.run.checkpoint_seconds:
            return
        try:
            due = now - self._last_replay >= REPLAY_SECONDS
            self.save(learner, experience, counters, with_replay=due)
        except OSError as error:
            complain(NAME, f'no checkpoint, the one before is kept: {error}')

    def save(
        self,
        learner: ActorCritic,
        experience: Experience,
        counters: Counters,
        with_replay: bool = True,
    ) -> None:
        """Writes the newest episodes and, as worker 0, the actor as evaluated now and the state.

        Raises:
            OSError: If there is no room for them; what was there before is kept.
        """
        self._last_checkpoint = time.monotonic()
        if with_replay:
            self._last_replay = self._last_checkpoint
            kept = self._workers.share(self._config.replay.kept_transitions)
            save_replay(self.folder.replay_file(self._workers.rank), experience.replay, kept)
        if self._workers.is_first:
            self.folder.save_actor(LATEST_FILE, learner.evaluation_actor(), counters.env_steps)
            self.folder.save_state(learner, experience.statistics, counters)
