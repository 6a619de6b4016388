"""Running mean and standard deviation of network inputs, shared by all workers."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from policy_node.policies.actor import Normalizer
from policy_node.policies.network_shape import INPUT_CLIP
from policy_node.training.machine.distributed import Workers

# Smallest standard deviation (paper, appendix B: eps = 0.01).
SMALLEST_STD = 0.01


class RunningStatistics:
    """Sums over all inputs; `write` sets the mean and deviation of a `Normalizer` from them."""

    def __init__(self, size: int) -> None:
        self.count = torch.zeros(1, dtype=torch.float64)
        self.total = torch.zeros(size, dtype=torch.float64)
        self.total_square = torch.zeros(size, dtype=torch.float64)

    def update(self, values: ArrayLike, workers: Workers) -> None:
        """Add the rows of `values` (..., size) of all workers, clipped as inputs of networks are.

        All workers must call this together.
        """
        array = np.asarray(values, dtype=np.float64)
        rows = np.clip(array.reshape(-1, array.shape[-1]), -INPUT_CLIP, INPUT_CLIP)
        parts = ([len(rows)], rows.sum(axis=0), np.square(rows).sum(axis=0))
        added = workers.sum(torch.from_numpy(np.concatenate(parts)))
        size = len(self.total)
        self.count += added[:1]
        self.total += added[1 : 1 + size]
        self.total_square += added[1 + size :]

    def write(self, normalizer: Normalizer) -> None:
        """Set the normalizer to these statistics; without any it stays unchanged."""
        if not self.count:
            return
        mean = self.total / self.count
        variance = self.total_square / self.count - mean.square()
        normalizer.mean.copy_(mean)
        normalizer.std.copy_(variance.clamp(min=SMALLEST_STD**2).sqrt())

    def state(self) -> dict[str, Tensor]:
        """Return the sums, for a checkpoint."""
        return {'count': self.count, 'total': self.total, 'total_square': self.total_square}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Continue from sums that `state` returned.

        Raises:
            KeyError: If one is missing.
            ValueError: If one has another size.
        """
        for name, value in self.state().items():
            given = state[name]
            if given.shape != value.shape:
                raise ValueError(
                    f'{name} of inputs is {tuple(given.shape)}, not {tuple(value.shape)}'
                )
            value.copy_(given)
