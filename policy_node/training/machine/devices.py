"""Where tensors live, and how precise their products are."""

from __future__ import annotations

import os

import torch


def uses_bfloat16(precision: str, device: torch.device) -> bool:
    """Whether matrix products run in bfloat16; `auto` asks the processor."""
    if precision != 'auto':
        return precision == 'bfloat16'
    if device.type == 'cuda':
        return bool(torch.cuda.is_bf16_supported())
    return bool(torch.cpu._is_avx512_bf16_supported())


def choose_device(name: str) -> torch.device:
    """Returns the device called `auto`, `cpu` or `cuda`; `auto` takes a GPU where torch sees one.

    Raises:
        ValueError: If `cuda` is asked for and torch sees none.
    """
    if name == 'cuda' and not torch.cuda.is_available():
        raise ValueError('device cuda: torch sees no GPU; allowed: auto, cpu')
    if name == 'cpu' or not torch.cuda.is_available():
        return torch.device('cpu')
    return torch.device('cuda', int(os.environ.get('LOCAL_RANK', '0')))
