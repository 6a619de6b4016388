"""The jobs of a benchmark, each a training run in a folder of its own."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.config_values import config_from_dict
from policy_node.training.runs.run_folder import PROGRESS_FILE, STATE_FILE
from policy_node.training.runs.run_log import read_progress
from policy_node.training.runs.training_state import read_counters, read_state
from policy_node.training.studies.final import read_final

# What may differ between two parts of a job without another result to be expected; where a run
# started from is decided once, and its path depends on the working directory.
_MAY_DIFFER = (
    'simulation_threads',
    'torch_threads',
    'checkpoint_seconds',
    'kept_transitions',
    'device',
    'init_from',
)


@dataclass(frozen=True, slots=True)
class Arm:
    """One curve in a figure: what is compared.

    Attributes:
        name: Name of the folder and of the command-line option.
        label: Name in figures and tables.
        changes: Fields of `TrainConfig` that are the arm's own.
        factors: Whole-numbered fields of which it has that many times what the others have.
    """

    name: str
    label: str
    changes: Mapping[str, Any] = field(default_factory=dict)
    factors: Mapping[str, int] = field(default_factory=dict)

    @property
    def own(self) -> dict[str, Any]:
        """Fields in which it differs, and how."""
        return {**self.changes, **{name: f'x{factor}' for name, factor in self.factors.items()}}


_NO_HINDSIGHT = {'strategy': 'none', 'goals': ''}
# The four curves in each panel of the paper's figures.
ARMS = {
    arm.name: arm
    for arm in (
        Arm('her_sparse', 'DDPG+HER, sparse', {'reward_type': 'sparse'}),
        Arm('her_dense', 'DDPG+HER, dense', {'reward_type': 'dense'}),
        Arm('ddpg_sparse', 'DDPG, sparse', {'reward_type': 'sparse', **_NO_HINDSIGHT}),
        Arm('ddpg_dense', 'DDPG, dense', {'reward_type': 'dense', **_NO_HINDSIGHT}),
    )
}


BEST_ARM = Arm('best', 'DDPG+HER, best recipe')


def differing_fields(stored: Mapping[str, Any], config: TrainConfig) -> dict[str, str]:
    """Fields by which another result is to be expected, each with both values in words.

    Args:
        stored: What `dataclasses.asdict` gave, through JSON; fields that came later have their
            default.
        config: A configuration.

    Raises:
        ValueError: If the stored one has unknown fields or values that are not allowed.
    """
    before, now = dataclasses.asdict(config_from_dict(dict(stored))), dataclasses.asdict(config)
    return {
        name: f'{name} {value!r}, now {now[name]!r}'
        for name, value in before.items()
        if value != now[name] and name not in _MAY_DIFFER
    }


def differing_runs(stored: Mapping[str, Any], config: TrainConfig) -> dict[str, str]:
    """As `differing_fields`, of runs of two places: where they started from counts as well."""
    before, now = stored.get('init_from', ''), config.init_from
    start = {} if before == now else {'init_from': f'init_from {before!r}, now {now!r}'}
    return {**differing_fields(stored, config), **start}


def run_name(task: str, arm: str, seed: int) -> str:
    """Task, arm and seed of a run, as in the path of its folder."""
    return f'{task}/{arm}/seed{seed}'


@dataclass(frozen=True, slots=True)
class Job:
    """One training run.

    Attributes:
        arm: What is compared.
        config: The whole configuration.
        folder: Output of `train_her`.
        after: The job whose networks it starts from; None starts from nothing.
        final_episodes: Fresh episodes on which the last actor is measured; 0 measures nothing.
    """

    arm: Arm
    config: TrainConfig
    folder: Path
    after: Job | None = None
    final_episodes: int = 0

    @property
    def name(self) -> str:
        """Task, arm and seed, as in the path of the folder."""
        return run_name(self.config.task, self.arm.name, self.config.seed)

    @property
    def is_finished(self) -> bool:
        """Whether the budget is spent, so that the curve is whole, and the end measured."""
        return self.is_trained and self._is_measured

    @property
    def _is_measured(self) -> bool:
        if not self.final_episodes:
            return True
        found = read_final(self.folder)
        return found is not None and found['episodes'] == self.final_episodes

    @property
    def is_trained(self) -> bool:
        """Whether the budget is spent and the end saved; a log may be ahead of what was saved."""
        if not self.has_checkpoint:
            return False
        return read_counters(self.folder / STATE_FILE).env_steps >= self.config.total_steps

    @property
    def is_ready(self) -> bool:
        """Whether what it starts from is there."""
        return self.after is None or self.has_checkpoint or self.after.is_finished

    @property
    def has_checkpoint(self) -> bool:
        """Whether there is something to continue."""
        return (self.folder / STATE_FILE).is_file()

    @property
    def env_steps(self) -> float:
        """Environment steps logged so far."""
        rows = self._rows()
        return rows[-1].get('env_steps', 0.0) if rows else 0.0

    @property
    def status(self) -> str:
        """How far it is, in one line."""
        rows, steps, total = self._rows(), self.env_steps, self.config.total_steps
        evaluated = [row['eval_success'] for row in rows if 'eval_success' in row]
        success = f'{evaluated[-1]:.3f}' if evaluated else '-'
        speed = rows[-1].get('steps_per_second', 0.0) if rows else 0.0
        left = f'{(total - steps) / speed / 3600:.1f} h' if speed else '-'
        return f'{self.name}: {steps:,.0f} of {total:,} steps, eval {success}, ETA {left}'

    def _rows(self) -> list[dict[str, float]]:
        path = self.folder / PROGRESS_FILE
        return read_progress(path) if path.is_file() else []

    def check_configuration(self) -> None:
        """Refuses a folder whose run was configured otherwise.

        Raises:
            ValueError: The message names the fields.
        """
        if not self.has_checkpoint:
            return
        try:
            stored = read_state(self.folder / STATE_FILE).extra['config']
        except ValueError as error:
            raise ValueError(f'{error}; without {self.folder} it is run again') from None
        differing = differing_fields(stored, self.config)
        if differing:
            raise ValueError(
                f'{self.folder} holds a run with {"; ".join(differing.values())}: '
                'choose another --output'
            )
