"""When a run writes what: the best actor, and checkpoints to go on from."""

from __future__ import annotations

import time
from collections.abc import Mapping
from typing import Any

from msgs_spec.command_line import complain
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.training.evaluation.episodes import EpisodeOutcomes, diagnose
from policy_node.training.evaluation.evaluator import success_rate
from policy_node.training.learning.actor_critic import ActorCritic
from policy_node.training.learning.distributed import Workers
from policy_node.training.learning.experience import Experience
from policy_node.training.learning.replay_file import save_replay
from policy_node.training.learning.run_folder import BEST_FILE, LATEST_FILE, RunFolder
from policy_node.training.learning.state_checks import is_finite
from policy_node.training.learning.training_state import Counters

NAME = 'train_her'
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

    def keep_best(self, outcomes: EpisodeOutcomes, actor: Actor, counters: Counters) -> None:
        """Saves an evaluated actor if it succeeds more often, or as often and sooner."""
        rule = self._config.success_rule
        success = success_rate(outcomes, rule)
        mean_return = float(outcomes.episode_return.mean())
        if (success, mean_return) > (counters.best_success, counters.best_return):
            counters.best_success, counters.best_return = success, mean_return
            if self._workers.is_first:
                measured = {'last_step': success, 'episodes': len(outcomes), 'rule': rule}
                measured |= {'mean_return': mean_return, **diagnose(outcomes)}
                self.folder.save_actor(BEST_FILE, actor, counters.env_steps, measured)

    def keep_no_worse(self, counters: Counters) -> None:
        """Lets the best actor in the folder stay, which a killed run may have saved last.

        An actor of fewer episodes, by another rule or without a measured return decides nothing.
        Where it is gone or damaged, the next one that is evaluated takes its place: a run must not
        end with a success that no file has.
        """
        file = self.folder.path / BEST_FILE
        try:
            if counters.best_success >= 0 and not file.is_file():
                raise ValueError(f'{file} is gone')
            found = checkpoint.load(file)[1].success if file.is_file() else {}
        except ValueError as error:
            if self._workers.is_first:
                complain(NAME, f'{error}; the best actor is looked for anew')
            counters.best_success, counters.best_return = Counters().best_success, -1e9
            return
        best = self._decided_by(found)
        if best is not None:
            known = counters.best_success, counters.best_return
            counters.best_success, counters.best_return = max(known, best)

    def _decided_by(self, found: Mapping[str, Any]) -> tuple[float, float] | None:
        """Success and return of an evaluation as those of this run; None if it was none."""
        names = 'episodes', 'last_step', 'mean_return'
        numbers = [float(found[name]) for name in names if is_finite(found.get(name))]
        if found.get('rule') != self._config.success_rule or len(numbers) < len(names):
            return None
        episodes, success, mean_return = numbers
        enough = episodes >= self._config.evaluation_episodes
        return (success, mean_return) if enough and 0.0 <= success <= 1.0 else None

    def save_when_due(
        self, learner: ActorCritic, experience: Experience, counters: Counters
    ) -> None:
        """Writes a checkpoint now and then, the replay more seldom; a full disk may empty."""
        now = time.monotonic()
        if now - self._last_checkpoint < self._config.checkpoint_seconds:
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
            kept = self._workers.share(self._config.kept_transitions)
            save_replay(self.folder.replay_file(self._workers.rank), experience.replay, kept)
        if self._workers.is_first:
            self.folder.save_actor(LATEST_FILE, learner.evaluation_actor(), counters.env_steps)
            self.folder.save_state(learner, experience.statistics, counters)
