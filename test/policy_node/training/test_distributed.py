"""Averaging over real gloo workers."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest
import torch

from policy_node.training.machine import Workers, join_workers

PROGRAM = """
import pytest
import torch
from policy_node.training.machine import join_workers, leave_workers
from policy_node.training.experience.experience import RunningStatistics
from policy_node.policies.actor import Normalizer

workers = join_workers(torch.device('cpu'))
rank = workers.rank
assert workers.world_size == 2 and workers.is_first == (rank == 0)

gradients = [torch.full((2, 3), float(rank)), torch.arange(4.0) * (rank + 1)]
workers.average_gradients(gradients)
assert gradients[0].eq(0.5).all() and gradients[1].tolist() == [0.0, 1.5, 3.0, 4.5]

weights = [torch.full((3,), float(rank + 7)), torch.full((1, 2), float(rank))]
workers.broadcast(weights)
assert weights[0].eq(7).all() and weights[1].eq(0).all()

assert workers.any(rank == 1) and not workers.any(False)
assert workers.share(9) == 5

statistics, normalizer = RunningStatistics(1), Normalizer(1)
statistics.update([[[1.0], [3.0]], [[5.0]]][rank], workers)
statistics.write(normalizer)
assert normalizer.mean.item() == 3.0 and abs(normalizer.std.item() - (8 / 3) ** 0.5) < 1e-6
leave_workers(workers)
"""


@pytest.mark.release
def test_two_workers_agree():
    command = [sys.executable, '-m', 'torch.distributed.run', '--nproc-per-node', '2']
    command += ['--rdzv-backend', 'c10d', '--rdzv-endpoint', 'localhost:0', '--no-python']
    command += [sys.executable, '-c', PROGRAM]
    environment = {**os.environ, 'OMP_NUM_THREADS': '1'}
    result = subprocess.run(command, capture_output=True, text=True, timeout=120, env=environment)
    assert result.returncode == 0, result.stderr


def test_a_single_process_is_alone():
    assert join_workers(torch.device('cpu')) == Workers()
    gradients = [torch.tensor([1.0, 2.0])]
    Workers().average_gradients(gradients)
    assert gradients[0].tolist() == [1.0, 2.0]
    assert Workers().share(9) == 9 and Workers().any(True) and not Workers().any(False)
