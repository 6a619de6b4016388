"""The folder of a run: best and latest actor, training state and replay."""

from __future__ import annotations

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from msgs_spec.tasks import task_spec
from node_runtime.command_line import complain
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.checkpoint import ActorInfo
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import to_flat
from policy_node.training.evaluation import EpisodeOutcomes, diagnose, success_rate
from policy_node.training.experience.episode_files import save_replay
from policy_node.training.experience.experience import Experience
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.machine import Workers
from policy_node.training.runs.training_state import Counters, is_finite, save_state

NAME = 'fetch_hand_sim train'
STATE_FILE = 'training_state.safetensors'
LATEST_FILE = 'latest.safetensors'
BEST_FILE = 'best.safetensors'
REPLAY_FILE = 'replay.safetensors'
LOCK_FILE = '.lock'
COMMAND_FILE = 'command.txt'
BOARD_FOLDER = 'tensorboard'
PROGRESS_FILE = 'progress.csv'
CURVE_FILE = 'curve.png'
# Seconds between copies of the newest episodes.
REPLAY_SECONDS = 900.0


def default_folder(config: TrainConfig) -> Path:
    """Return the folder of a run without `--output`: runs/<task>_<recipe>_seed<seed>."""
    return Path('runs') / f'{config.task}_{config.recipe}_seed{config.seed}'


def companion_file(actor: Path) -> Path:
    """Return the path of the critic that belongs to a shipped actor, beside its file."""
    return actor.with_suffix('.training.safetensors')


def set_former_run_aside(folder: Path) -> str:
    """Move the actors, replay and logs of an earlier run into a new subfolder `former*`.

    Otherwise a new run in `folder` would append to the earlier log or keep the earlier best actor.

    Returns:
        A sentence that names both folders; '' if there were no files.
    """
    names = (BEST_FILE, LATEST_FILE, PROGRESS_FILE, CURVE_FILE, COMMAND_FILE, BOARD_FOLDER)
    found = [folder / name for name in names if (folder / name).exists()]
    found += folder.glob(f'*{REPLAY_FILE}')
    if not found:
        return ''
    former = (folder / f'former{number}' for number in itertools.count(1))
    target = next(each for each in former if not each.exists())
    target.mkdir()
    for path in found:
        path.replace(target / path.name)
    return f'files of an earlier run in {folder} are now in {target}'


@contextmanager
def disk_warning(lost: str) -> Iterator[None]:
    """Only warn if a file cannot be written in the block; `lost` names the consequence."""
    try:
        yield
    except OSError as error:
        # stderr may be a file on the same full disk.
        with suppress(OSError):
            complain(NAME, f'{lost}: {error}')


@dataclass(slots=True)
class RunFolder:
    """Writes the actors, the training state and the replay of a run on one worker.

    Attributes:
        workers: This worker. Only the first worker writes actors and the training state.
        command: Command line or call that started the run, for the record.
        init_from: Origin of the initial networks; empty if they were random. The trainer sets it.
    """

    path: Path
    config: TrainConfig
    workers: Workers = field(default_factory=Workers)
    command: str = ''
    source_revision: str = ''
    init_from: dict[str, Any] = field(default_factory=dict)
    _last_checkpoint: float = field(default_factory=time.monotonic)
    _last_replay: float = field(default_factory=time.monotonic)

    def replay_file(self) -> Path:
        """Return the path at which this worker saves its newest episodes, to resume from."""
        rank = self.workers.rank
        return self.path / (REPLAY_FILE if rank == 0 else f'{rank}.{REPLAY_FILE}')

    def keep_best(self, outcomes: EpisodeOutcomes, actor: Actor, counters: Counters) -> None:
        """Save an evaluated actor if its success rate is the highest of the run so far.

        At equal success rates, the mean return decides. `counters` gets both values of the new best
        actor. An evaluation of fewer than `evaluation_episodes` episodes has no effect. An actor
        that cannot be written has no effect either. Only the first worker evaluates actors.
        """
        rule = self.config.success_rule
        success = success_rate(outcomes, rule)
        mean_return = float(outcomes.episode_return.mean())
        is_better = (success, mean_return) > (counters.best_success, counters.best_return)
        if not is_better or len(outcomes) < self.config.evaluation_episodes:
            return
        with disk_warning('the best actor is not written, the one before is kept'):
            measured = {'last_step': success, 'episodes': len(outcomes), 'rule': rule}
            measured |= {'mean_return': mean_return, **diagnose(outcomes)}
            self.save_actor(BEST_FILE, actor, counters.env_steps, measured)
            counters.best_success, counters.best_return = success, mean_return

    def read_best(self, counters: Counters) -> None:
        """Set the best success and return of a resumed run, in `counters`, from its best actor.

        The best actor may be newer than the training state. Its file may be missing, damaged or of
        another task, or its evaluation may have had fewer episodes or another `success_rule`. Then
        both values become those of a new run, so that the next evaluated actor replaces it.
        """
        file, rule = self.path / BEST_FILE, self.config.success_rule
        if counters.best_success < 0 and not file.is_file():
            return
        try:
            found = checkpoint.read(file, self.config.task).info.success
            episodes, success = found.get('episodes'), found.get('last_step')
            is_short = is_finite(episodes) and episodes < self.config.evaluation_episodes
            if is_short or found.get('rule', rule) != rule:
                raise ValueError(f'{file} had another evaluation')
        except ValueError as error:
            if self.workers.is_first:
                complain(NAME, f'{error}; the next evaluated actor replaces it')
            unknown = Counters()
            counters.best_success, counters.best_return = unknown.best_success, unknown.best_return
            return
        known, mean_return = (counters.best_success, counters.best_return), found.get('mean_return')
        if is_finite(success) and is_finite(mean_return) and 0 <= success <= 1:
            counters.best_success, counters.best_return = max(known, (success, mean_return))

    def save_when_due(
        self, learner: ActorCritic, experience: Experience, counters: Counters
    ) -> None:
        """Save as `save` does when the last checkpoint is `checkpoint_seconds` old.

        The episodes are written only every 900 s. If a file cannot be written, for example on a
        full disk, only warn.
        """
        now = time.monotonic()
        if now - self._last_checkpoint < self.config.checkpoint_seconds:
            return
        with disk_warning('no checkpoint, the one before is kept'):
            self._save_state(learner, experience, counters)
        if now - self._last_replay >= REPLAY_SECONDS:
            with disk_warning('no newer replay for --resume'):
                self._save_replay(experience)

    def save(self, learner: ActorCritic, experience: Experience, counters: Counters) -> None:
        """Write actor and training state, on the first worker, then the newest episodes.

        A disk that is too full for the episodes still gets actor and training state.

        Raises:
            OSError: If a file cannot be written; its earlier version stays.
        """
        self._save_state(learner, experience, counters)
        self._save_replay(experience)

    def _save_replay(self, experience: Experience) -> None:
        self._last_replay = time.monotonic()
        kept = self.workers.share(self.config.kept_transitions)
        save_replay(self.replay_file(), experience.replay, kept)

    def _save_state(self, learner: ActorCritic, experience: Experience, counters: Counters) -> None:
        self._last_checkpoint = time.monotonic()
        if self.workers.is_first:
            self.save_actor(LATEST_FILE, learner.evaluation_actor(), counters.env_steps)
            extra = {'config': to_flat(self.config), 'command': self.command}
            extra |= {'init_from': self.init_from}
            save_state(self.path / STATE_FILE, learner, experience.statistics, counters, extra)

    def save_actor(
        self, name: str, actor: Actor, env_steps: int, success: dict[str, Any] | None = None
    ) -> None:
        """Write an actor with metadata to the file `name`; `success` is its evaluation, if any."""
        config, spec = self.config, task_spec(self.config.task)
        info = ActorInfo(
            task=config.task,
            observation_layout=checkpoint.observation_layout(spec),
            goal_size=spec.goal.size,
            action_size=spec.robot.action_size,
            hidden_sizes=config.hidden_sizes,
            layer_norm=config.layer_norm,
            control_hz=config.control_hz,
            seed=config.seed,
            command=self.command,
            source_revision=self.source_revision,
            env_steps=env_steps,
            config=to_flat(config),
            success=success or {},
            goal_features=config.goal_features,
            init_from=self.init_from,
            past_actions=config.past_actions,
        )
        checkpoint.save(self.path / name, actor, info)
