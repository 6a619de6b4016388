"""What a training state may hold: refused before anything is made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeGuard

import torch
from torch import Tensor

# Whole numbers up to here are exact wherever they are counted with.
_LARGEST_COUNT = 2**53
# What Adam keeps of each parameter once it has moved it.
_OF_ADAM = {'step', 'exp_avg', 'exp_avg_sq'}


def is_finite(value: object) -> TypeGuard[int | float]:
    """Whether a value from a file is a finite number; True and False are none."""
    return isinstance(value, int | float) and type(value) is not bool and math.isfinite(value)


def require_counters(values: object, defaults: Mapping[str, int | float]) -> dict[str, Any]:
    """Refuses counters that are none: wrong names, types, negative counts, values not finite.

    Args:
        values: What a file has.
        defaults: All counters, with a value of their type.

    Returns:
        The counters.

    Raises:
        ValueError: If one is not allowed.
    """
    if not isinstance(values, dict):
        raise ValueError(f'counters are {type(values).__name__}, no object')
    for name, value in values.items():
        if name not in defaults:
            raise ValueError(f'counter {name!r} is not known; allowed: {", ".join(defaults)}')
        if isinstance(defaults[name], int):
            if type(value) is not int or not 0 <= value <= _LARGEST_COUNT:
                raise ValueError(f'counter {name} is {value!r:.80}; allowed: 0 ... 2**53')
        elif not is_finite(value):
            raise ValueError(f'counter {name} is {value!r:.80}; allowed: a finite number')
    return values


def require_finite(tensors: Mapping[str, Tensor]) -> None:
    """Refuses values that are no numbers: a network with one would act on nothing else.

    Raises:
        ValueError: If there is one; the tensor is named.
    """
    if name := first_not_finite(tensors):
        raise ValueError(f'{name} has a value that is not finite')


def first_not_finite(tensors: Mapping[str, Tensor]) -> str:
    """Name of the first tensor with a value that is no finite number; empty if there is none."""
    for name, value in tensors.items():
        if value.is_floating_point() and not torch.isfinite(value).all():
            return name
    return ''


def require_adam(optimizer: torch.optim.Adam, state: Mapping[int, Mapping[str, Tensor]]) -> None:
    """Refuses moments of other sizes than the parameters: Adam would write beyond their end.

    Args:
        optimizer: That the state is for.
        state: Of some or all of its parameters, by their numbers.

    Raises:
        ValueError: If something is missing or does not fit.
    """
    parameters = optimizer.param_groups[0]['params']
    for index, values in state.items():
        if not 0 <= index < len(parameters):
            raise ValueError(f'moments of parameter {index}, of {len(parameters)}')
        if values.keys() != _OF_ADAM:
            raise ValueError(f'moments of parameter {index} are {sorted(values)}')
        for name, value in values.items():
            needed = () if name == 'step' else tuple(parameters[index].shape)
            if tuple(value.shape) != needed or not value.is_floating_point():
                given = f'{tuple(value.shape)} {value.dtype}'
                raise ValueError(f'{name} of parameter {index} is {given}, not {needed}')
