"""Synchronous workers under `torchrun`: averaged gradients and summed statistics.

Without `torchrun` there is one worker and no communication.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, distributed


@dataclass(frozen=True, slots=True)
class Workers:
    """This worker's place among all.

    Attributes:
        rank: Index of this worker; worker 0 writes logs and checkpoints.
        world_size: Number of workers.
        device: Device of messages: the GPU with nccl, else the CPU.
    """

    rank: int = 0
    world_size: int = 1
    device: torch.device = torch.device('cpu')

    @property
    def is_first(self) -> bool:
        """Return whether this is worker 0."""
        return self.rank == 0

    def share(self, total: int) -> int:
        """Return this worker's part of a total, rounded up."""
        return -(-total // self.world_size)

    def sum(self, values: Tensor) -> Tensor:
        """Return the sum of `values` over all workers, on the device of `values`."""
        if self.world_size == 1:
            return values
        message = values.to(self.device, copy=True)
        distributed.all_reduce(message)
        return message.to(values.device)

    def average_gradients(self, gradients: Sequence[Tensor]) -> None:
        """Replace each gradient by its mean over all workers, in one message."""
        if self.world_size == 1:
            return
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        mean = self.sum(flat) / self.world_size
        parts = torch.split(mean, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def broadcast(self, tensors: Sequence[Tensor]) -> None:
        """Copy the values of worker 0 to every worker."""
        if self.world_size == 1:
            return
        for tensor in tensors:
            message = tensor.detach().to(self.device, copy=True)
            distributed.broadcast(message, src=0)
            tensor.detach().copy_(message)

    def any(self, flag: bool) -> bool:
        """Return whether the flag is set on any worker; all must call this together."""
        return bool(self.sum(torch.tensor([float(flag)])).item() > 0)


def is_first_worker() -> bool:
    """Return whether this process will be worker 0, before the workers have joined."""
    return os.environ.get('RANK', '0') == '0'


def join_workers(device: torch.device) -> Workers:
    """Join the workers that `torchrun` started, or return a single worker."""
    world_size = int(os.environ.get('WORLD_SIZE', '1'))
    if world_size == 1:
        return Workers()
    backend = 'nccl' if device.type == 'cuda' else 'gloo'
    if device.type == 'cuda':
        torch.cuda.set_device(device)
    distributed.init_process_group(backend)
    return Workers(distributed.get_rank(), world_size, device)


def leave_workers(workers: Workers) -> None:
    """Close the connection to the other workers."""
    if workers.world_size > 1:
        distributed.destroy_process_group()
