"""Give networks more inputs or wider hidden layers without changing their outputs.

New inputs have zero weights. A hidden layer becomes wider by copying each unit the same number of
times, which leaves a LayerNorm unchanged. The next layer divides the unit's weight among the copies
(Net2Net, Chen et al. 2016, arXiv 1511.05641). The shares differ, so that copies learn different
things.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

# Smallest share of a unit that one of two copies gets.
_LEAST_SHARE = 0.3
_HIDDEN, _OUTPUT = 'hidden.', 'output.weight'


def with_inputs(tensors: dict[str, Tensor], column: int, count: int) -> dict[str, Tensor]:
    """Return networks with `count` more inputs from `column` on; their weights are zero."""
    changed = {}
    for name in first_weights(tensors):
        weight = tensors[name]
        zeros = weight.new_zeros((len(weight), count))
        changed[name] = torch.cat([weight[:, :column], zeros, weight[:, column:]], dim=1)
    return tensors | changed


def first_weights(tensors: dict[str, Tensor]) -> list[str]:
    """Return the names of the weights of layers that take the inputs."""
    return [name for name in tensors if name.endswith('hidden.0.weight')]


def can_widen(before: Sequence[int], after: Sequence[int]) -> bool:
    """Return whether layers of widths `before` can get the widths `after`, each a multiple."""
    if len(before) != len(after):
        return False
    return all(new % old == 0 for old, new in zip(before, after, strict=True))


def widened(tensors: dict[str, Tensor], after: Sequence[int]) -> dict[str, Tensor]:
    """Return networks with wider hidden layers; other tensors stay.

    Args:
        tensors: Named as in a training state: `<network>hidden.<n>.<name>` and
            `<network>output.<name>`.
        after: New widths, see `can_widen`.
    """
    changed: dict[str, Tensor] = {}
    for name in tensors:
        if name.endswith(_OUTPUT):
            prefix = name.removesuffix(_OUTPUT)
            changed |= _widened_network(tensors, prefix, after)
    return tensors | changed


def _widened_network(
    tensors: dict[str, Tensor], prefix: str, after: Sequence[int]
) -> dict[str, Tensor]:
    # A network and its slow copy get the same shares.
    generator = torch.Generator().manual_seed(0)
    widths = iter(after)
    # For each unit of the layer before: its original unit and its share; None for inputs.
    unit: Tensor | None = None
    share = torch.ones(1)
    changed: dict[str, Tensor] = {}
    for number in _numbers(tensors, prefix):
        layer = f'{prefix}{_HIDDEN}{number}.'
        weight = tensors[f'{layer}weight']
        if weight.ndim == 2:
            if unit is not None:
                weight = weight[:, unit] * share
            units, width = len(weight), next(widths)
            unit = torch.arange(width) % units
            share = _shares(units, width // units, generator)
        for name in (name for name in tensors if name.startswith(layer)):
            values = weight if name.endswith('.weight') else tensors[name]
            # A normalization may have a count beside its values per unit.
            changed[name] = values[unit] if values.ndim else values
    output = prefix + _OUTPUT
    changed[output] = tensors[output][:, unit] * share
    return changed


def _numbers(tensors: dict[str, Tensor], prefix: str) -> list[int]:
    """Return the numbers of the hidden layers and norms of a network, sorted."""
    start = prefix + _HIDDEN
    found = {int(n.removeprefix(start).split('.')[0]) for n in tensors if n.startswith(start)}
    return sorted(found)


def _shares(units: int, copies: int, generator: torch.Generator) -> Tensor:
    """Return shares (copies * units,) that add up to 1 over the copies of each unit."""
    drawn = _LEAST_SHARE + (1.0 - 2.0 * _LEAST_SHARE) * torch.rand(
        (copies, units), generator=generator
    )
    return (drawn / drawn.sum(dim=0)).flatten()
