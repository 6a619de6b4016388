"""Critics that learn quantiles of the return, not its mean alone.

Quantile regression as in QR-DQN (Dabney et al. 2018, arXiv 1710.10044); `truncated` targets, which
leave out the highest quantiles of all critics together, as in TQC (Kuznetsov et al. 2020, arXiv
2005.04269).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

# TQC leaves out 2 of 25 for every critic (its table of hyper-parameters, most tasks).
DROPPED_SHARE = 2 / 25


def levels(count: int, like: Tensor) -> Tensor:
    """Probabilities (count,) that the quantiles are for: the middles of equal shares.

    Args:
        count: How many quantiles.
        like: Where they are to be.
    """
    return (torch.arange(count, dtype=torch.float32, device=like.device) + 0.5) / count


def pooled(quantiles: Tensor, truncated: bool) -> Tensor:
    """Quantiles of all critics as one sample of the return, (batch, kept).

    Args:
        quantiles: (critics, batch, count), of one critic (batch, count).
        truncated: Whether the highest are left out.
    """
    if quantiles.ndim == 2:
        quantiles = quantiles[None]
    together = quantiles.transpose(0, 1).flatten(1)
    if not truncated:
        return together
    total = together.shape[1]
    kept = total - max(round(total * DROPPED_SHARE), 1)
    return together.sort(dim=1).values[:, :kept]


def quantile_costs(quantiles: Tensor, target: Tensor) -> Tensor:
    """Quantile Huber loss of each transition, (critics, batch), of one critic (batch,).

    Args:
        quantiles: (critics, batch, count), of one critic (batch, count).
        target: (batch, kept): what the return was, in equal parts.
    """
    error = target.unsqueeze(-2) - quantiles.unsqueeze(-1)
    huber = nn.functional.huber_loss(error, torch.zeros_like(error), reduction='none')
    level = levels(quantiles.shape[-1], quantiles)[:, None]
    weight = (level - (error.detach() < 0.0).float()).abs()
    cost: Tensor = (weight * huber).mean(dim=(-2, -1))
    return cost
