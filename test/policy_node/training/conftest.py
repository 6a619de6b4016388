"""A finished run, and one thread for torch."""

import shutil
from pathlib import Path

import pytest
import torch

from policy_node.training.runs.run import Caller, train_run
from support.runs import small

# Small products: more threads only wait for each other, and on a busy machine for very long.
torch.set_num_threads(1)


@pytest.fixture(scope='session')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a run of 1,200 steps, which no test may change."""
    folder = tmp_path_factory.mktemp('finished') / 'run'
    train_run(small(total_steps=1_200), folder, caller=Caller(quiet=True))
    return folder


@pytest.fixture
def run(finished: Path, tmp_path: Path) -> Path:
    """Return a copy of the finished run."""
    return shutil.copytree(finished, tmp_path / 'run')
