"""The hardware of a run (device, memory, threads) and communication between its workers."""

from __future__ import annotations

import contextlib
import os
import platform
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, distributed

from policy_node.training.configuration.config import TrainConfig

_MEMINFO = Path('/proc/meminfo')
# Limit and use of a container (cgroup v2).
_CONTAINER = Path('/sys/fs/cgroup')


def available_memory() -> int | None:
    """Return the bytes that this process can allocate without swapping, or None if unknown."""
    found = []
    with contextlib.suppress(OSError, StopIteration, ValueError):
        lines = _MEMINFO.read_text().splitlines()
        kilobytes = next(line.split()[1] for line in lines if line.startswith('MemAvailable:'))
        found.append(int(kilobytes) * 1024)
    with contextlib.suppress(OSError, ValueError):
        limit = int((_CONTAINER / 'memory.max').read_text())
        found.append(max(limit - int((_CONTAINER / 'memory.current').read_text()), 0))
    return min(found, default=None)


def processor() -> str:
    """Return the name of the processor, or its architecture if Linux reports no name."""
    info = Path('/proc/cpuinfo')
    lines = info.read_text().splitlines() if info.is_file() else []
    models = [line.split(':')[1].strip() for line in lines if line.startswith('model name')]
    return models[0] if models else platform.machine()


def split_threads(config: TrainConfig) -> tuple[int, int]:
    """Return the number of simulation threads and the number of tensor threads of this worker.

    A number that is 0 in the configuration is chosen from the cores of this worker. If collecting
    and learning overlap, they share these cores. For networks of 3 x 256 units, a second tensor
    thread gains 5 % with batches of 1024 and 80 % with batches of 4096 (measured on 4 cores).
    """
    local_workers = int(os.environ.get('LOCAL_WORLD_SIZE', '1'))
    cores = max(len(os.sched_getaffinity(0)) // local_workers, 1)
    small = config.batch_size <= 1024
    tensor_threads = config.torch_threads or (1 if small else max(cores // 2, 1))
    rest = max(cores - tensor_threads, 1) if config.overlap else cores
    return config.simulation_threads or rest, tensor_threads


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Return whether matrix products use bfloat16; `auto` uses it if the device supports it."""
    if precision != 'auto':
        return precision == 'bfloat16'
    if device.type == 'cuda':
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported())


def choose_device(name: str) -> torch.device:
    """Return the torch device for `cpu`, `cuda` or `auto` (a GPU if torch has one, else the CPU).

    With `torchrun`, each worker of a machine gets its own GPU.

    Raises:
        ValueError: If `name` is `cuda` and torch has no GPU.
    """
    if name == 'cuda' and not torch.cuda.is_available():
        raise ValueError('device cuda: torch has no GPU; allowed: auto, cpu')
    if name == 'cpu' or not torch.cuda.is_available():
        return torch.device('cpu')
    return torch.device('cuda', int(os.environ.get('LOCAL_RANK', '0')))


@dataclass(frozen=True, slots=True)
class Workers:
    """This worker process and its connection to the other workers of the run.

    Attributes:
        rank: Index of this worker; worker 0 writes logs and checkpoints.
        world_size: Number of workers.
        device: Device of the tensors that workers exchange: the GPU with nccl, else the CPU.
    """

    rank: int = 0
    world_size: int = 1
    device: torch.device = torch.device('cpu')

    @property
    def is_first(self) -> bool:
        """Return whether this is worker 0."""
        return self.rank == 0

    def share(self, total: int) -> int:
        """Return `total` divided by the number of workers, rounded up."""
        return -(-total // self.world_size)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of `values` over all workers, on the device of `values`.

        All workers must call this together.
        """
        if self.world_size == 1:
            return values
        message = values.to(self.device, copy=True)
        distributed.all_reduce(message)
        return message.to(values.device)

    def average_gradients(self, gradients: Sequence[Tensor]) -> None:
        """Replace each gradient, in place, by its mean over all workers.

        All workers must call this together.
        """
        if self.world_size == 1:
            return
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        mean = self.sum(flat) / self.world_size
        parts = torch.split(mean, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def broadcast(self, tensors: Sequence[Tensor]) -> None:
        """Overwrite `tensors` of every worker with those of worker 0.

        All workers must call this together.
        """
        if self.world_size == 1:
            return
        for tensor in tensors:
            values = tensor.detach()
            values.copy_(self.sum(values if self.is_first else torch.zeros_like(values)))

    def any(self, flag: bool) -> bool:
        """Return whether `flag` is True on any worker. All workers must call this together."""
        return bool(self.sum(torch.tensor([float(flag)])).item() > 0)


def is_first_worker() -> bool:
    """Return whether this process is worker 0; works before `join_workers`."""
    return os.environ.get('RANK', '0') == '0'


def join_workers(device: torch.device) -> Workers:
    """Connect to the other workers that `torchrun` started; return this worker.

    Without `torchrun` there is a single worker.
    """
    world_size = int(os.environ.get('WORLD_SIZE', '1'))
    if world_size == 1:
        return Workers()
    backend = 'nccl' if device.type == 'cuda' else 'gloo'
    if device.type == 'cuda':
        torch.cuda.set_device(device)
    distributed.init_process_group(backend)
    return Workers(distributed.get_rank(), world_size, device)


def leave_workers(workers: Workers) -> None:
    """Close the connection to the other workers, if there are any."""
    if workers.world_size > 1:
        distributed.destroy_process_group()
