"""Small training runs: a cycle takes a fraction of a second."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from policy_node.policies.files import read_tensors
from policy_node.training.configuration.config import TrainConfig
from policy_node.training.configuration.flat import value_text
from policy_node.training.configuration.recipes import recipe_config
from policy_node.training.evaluation import EpisodeOutcomes
from policy_node.training.runs.run_folder import RunFolder
from policy_node.training.runs.trainer import Trainer

torch.set_num_threads(1)

# A cycle has 8 episodes, for FetchReach 400 steps.
SMALL: dict[str, Any] = {
    'num_envs': 8,
    'updates_per_cycle': 4,
    'batch_size': 64,
    'hidden_sizes': (16, 16),
    'evaluation_episodes': 8,
    'evaluate_every': 400,
    'simulation_threads': 1,
    'torch_threads': 1,
}
STATE = 'training_state.safetensors'


def small(task: str = 'FetchReach', **changes: Any) -> TrainConfig:
    """The configuration of a small run."""
    return recipe_config(task, 'best', **{**SMALL, **changes})


def options_of(**fields: Any) -> list[str]:
    """Fields as options of the command line."""
    return [f'--set={name}={value_text(value)}' for name, value in fields.items()]


def trainer_of(folder: Path, **changes: Any) -> Trainer:
    """A trainer of a small run."""
    return Trainer(RunFolder(folder, small(**changes)))


def trained(folder: Path, **changes: Any) -> Trainer:
    """A trainer whose run has ended."""
    trainer = trainer_of(folder, **changes)
    trainer.train()
    return trainer


def resumed(folder: Path, **changes: Any) -> Trainer:
    """A trainer that continues the run in a folder."""
    trainer = trainer_of(folder, **changes)
    trainer.resume(folder / STATE)
    return trainer


def weights(file: Path) -> dict[str, torch.Tensor]:
    """The tensors of a file."""
    return {name: torch.tensor(values) for name, values in read_tensors(file)[0].items()}


def same(first: dict[str, torch.Tensor], second: dict[str, torch.Tensor]) -> bool:
    """Return whether both have the same tensors."""
    return first.keys() == second.keys() and all(torch.equal(first[n], second[n]) for n in first)


def outcomes_of(success: Any, **others: Any) -> EpisodeOutcomes:
    """Return outcomes of `len(success)` episodes. Values that are not given are 0."""
    zeros = {name: np.zeros(len(success)) for name in EpisodeOutcomes.__slots__}
    return EpisodeOutcomes(**zeros | {'success_gymnasium': np.array(success)} | others)


def one_line(capsys: Any) -> str:
    """The one line that stderr has."""
    error: str = capsys.readouterr().err
    assert error.count('\n') == 1, error
    return error
