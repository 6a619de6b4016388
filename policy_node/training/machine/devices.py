"""Device of the networks and precision of their matrix products."""

from __future__ import annotations

import os

import torch


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Return whether matrix products run in bfloat16; with `auto` if the device supports it."""
    if precision != 'auto':
        return precision == 'bfloat16'
    if device.type == 'cuda':
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported())


def choose_device(name: str) -> torch.device:
    """Return the device `cpu` or `cuda`; `auto` is a GPU if torch has one.

    Raises:
        ValueError: If `name` is `cuda` and torch has no GPU.
    """
    if name == 'cuda' and not torch.cuda.is_available():
        raise ValueError('device cuda: torch has no GPU; allowed: auto, cpu')
    if name == 'cpu' or not torch.cuda.is_available():
        return torch.device('cpu')
    return torch.device('cuda', int(os.environ.get('LOCAL_RANK', '0')))
