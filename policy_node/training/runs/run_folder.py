"""The files of a run and what goes into them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from msgs_spec.tasks import task_spec
from policy_node.policies import checkpoint
from policy_node.policies.actor import Actor
from policy_node.policies.checkpoint import ActorInfo
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import to_flat
from policy_node.training.experience.frame_skip import plain_actor
from policy_node.training.experience.statistics import RunningStatistics
from policy_node.training.learners.actor_critic import ActorCritic
from policy_node.training.runs.training_state import Counters, save_state

STATE_FILE = 'training_state.safetensors'
LATEST_FILE = 'latest.safetensors'
BEST_FILE = 'best.safetensors'
REPLAY_FILE = 'replay.safetensors'
LOCK_FILE = '.lock'
COMMAND_FILE = 'command.txt'
BOARD_FOLDER = 'tensorboard'
PROGRESS_FILE = 'progress.csv'
CURVE_FILE = 'curve.png'
_OF_FORMER_RUNS = (BEST_FILE, LATEST_FILE, PROGRESS_FILE, CURVE_FILE)


def default_folder(config: TrainConfig) -> Path:
    """Where a run goes that was given no folder."""
    return Path('runs') / f'{config.task}_{config.recipe}_seed{config.seed}'


def companion_file(actor: Path) -> Path:
    """Where the critic of an actor lies, so that training can go on from it."""
    return actor.with_suffix('.training.safetensors')


def set_former_run_aside(folder: Path) -> str:
    """Makes room for a run that begins in the folder of another, of which no state is left.

    It would take the best actor for its own. Actors, log and curve may be all that somebody has
    kept, so they get other names, `former_*`; the rest goes.

    Returns:
        What to say of it; '' if nothing.

    Raises:
        OSError: If a file cannot be renamed or removed.
    """
    kept = [name for name in _OF_FORMER_RUNS if _holds_something(folder / name)]
    prefixes = itertools.chain(['former'], (f'former{number}' for number in itertools.count(2)))
    prefix = next(each for each in prefixes if not any(folder.glob(f'{each}_*')))
    for name in kept:
        (folder / name).replace(folder / f'{prefix}_{name}')
    said = f'{", ".join(kept)} of an earlier run in {folder}: now {prefix}_*' if kept else ''
    files = [folder / REPLAY_FILE]
    replays = folder.glob(f'*.{REPLAY_FILE}')
    files += [file for file in replays if file.name.partition('.')[0].isdecimal()]
    files += folder.glob(f'{BOARD_FOLDER}/events.out.tfevents.*')
    for file in files:
        file.unlink(missing_ok=True)
    return said


def _holds_something(path: Path) -> bool:
    """Whether a file is worth keeping: a log that no cycle has ended in is not."""
    if not path.is_file():
        return False
    return path.name != PROGRESS_FILE or path.read_bytes().count(b'\n') > 1


@dataclass(frozen=True, slots=True)
class RunFolder:
    """Where a run writes its actors and the state that `--resume` goes on from.

    Attributes:
        path: The folder.
        config: Configuration of the run.
        command: Command line, for the metadata of actors.
        source_revision: Revision of the source, likewise.
        init_from: Origin of the networks the run started from; empty if they were random.
    """

    path: Path
    config: TrainConfig
    command: str = ''
    source_revision: str = ''
    init_from: dict[str, Any] = field(default_factory=dict)

    def save_actor(
        self, name: str, actor: Actor, env_steps: int, success: dict[str, Any] | None = None
    ) -> None:
        """Writes an actor with everything that is needed to run it and to know it by.

        Args:
            name: `LATEST_FILE` or `BEST_FILE`.
            actor: The actor.
            env_steps: Environment steps behind it.
            success: Measured success, if any.
        """
        config, spec = self.config, task_spec(self.config.task)
        info = ActorInfo(
            task=config.task,
            observation_layout=checkpoint.observation_layout(spec),
            goal_size=spec.goal.size,
            action_size=spec.robot.action_size,
            hidden_sizes=config.network.hidden_sizes,
            layer_norm=config.network.layer_norm,
            control_hz=config.collect.control_hz,
            seed=config.seed,
            command=self.command,
            source_revision=self.source_revision,
            env_steps=env_steps,
            config=to_flat(config),
            success=success or {},
            goal_features=config.network.goal_features,
            init_from=self.init_from,
            past_actions=config.network.past_actions,
        )
        checkpoint.save(self.path / name, plain_actor(actor, config), info)

    def replay_file(self, rank: int) -> Path:
        """Where a worker keeps its newest episodes."""
        return self.path / (REPLAY_FILE if rank == 0 else f'{rank}.{REPLAY_FILE}')

    def save_state(
        self, learner: ActorCritic, statistics: dict[str, RunningStatistics], counters: Counters
    ) -> None:
        """Writes everything that a resumed run needs but the replay."""
        config = to_flat(self.config)
        extra = {'config': config, 'command': self.command, 'init_from': self.init_from}
        save_state(self.path / STATE_FILE, learner, statistics, counters, extra)
