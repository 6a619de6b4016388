"""Training configurations from text and JSON."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np

from msgs_spec.text import did_you_mean
from policy_node.training.configuration.config import TrainConfig

# Floats know all whole numbers up to here.
_EXACT = 2**53


def parse_assignment(text: str) -> tuple[str, Any]:
    """Parses `name=value` into a field of `TrainConfig` and a value of its type.

    Raises:
        ValueError: If there is no such field or the value does not fit its type.
    """
    name, separator, value = text.partition('=')
    hints = typing.get_type_hints(TrainConfig)
    if name not in hints:
        near = did_you_mean(name, list(hints))
        raise ValueError(f'{text!r} is not name=value{near}; names: {", ".join(hints)}')
    if not separator:
        raise ValueError(f'{text!r} is not name=value: give {name}=...')
    return name, parse_value(name, value)


def parse_value(name: str, text: str) -> Any:
    """Parses a value of the field `name`.

    Raises:
        ValueError: If it does not fit the field's type.
    """
    kind = typing.get_type_hints(TrainConfig)[name]
    try:
        return _parse(text, kind)
    except ValueError:
        if isinstance(kind, types.GenericAlias):
            raise ValueError(f'{name} {text!r} is not whole numbers with commas: N,N,...') from None
        kind = getattr(kind, '__name__', str(kind))
        raise ValueError(f'{name} {text!r} is not of type {kind}') from None


def _parse(value: str, kind: Any) -> Any:
    if kind is bool:
        choices = {'true': True, 'false': False, '1': True, '0': False}
        if value.lower() not in choices:
            raise ValueError(value)
        return choices[value.lower()]
    if isinstance(kind, types.GenericAlias):
        return tuple(int(part) for part in value.split(',') if part)
    if kind is int:
        return whole(value)
    return kind(value)


def whole(text: str) -> int:
    """Reads a whole number, also as `1_000_000` and `1e6`.

    Raises:
        ValueError: If it is none, or one that a float may have rounded.
    """
    try:
        return int(text)
    except ValueError:
        number = float(text)
        if not number.is_integer() or abs(number) > _EXACT:
            raise
        return int(number)


def config_from_dict(values: dict[str, Any]) -> TrainConfig:
    """Rebuilds a configuration from `dataclasses.asdict` that went through JSON.

    Fields that came later have their default; of one that did nothing, and is refused since, the
    value is left out.

    Raises:
        ValueError: If a field is unknown or a value not allowed.
    """
    fields = typed_fields(values)
    if fields.get('goals') or fields.get('strategy') != 'futureactual':
        fields.pop('future_only_steps', None)
    return TrainConfig(**fields)


def typed_fields(values: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of `TrainConfig` with values of their types: lists become tuples.

    Raises:
        ValueError: If there is no such field or a value is not of its type.
    """
    hints = typing.get_type_hints(TrainConfig)
    unknown = sorted(values.keys() - hints.keys())
    if unknown:
        near = did_you_mean(unknown[0], list(hints))
        raise ValueError(f'unknown configuration fields: {", ".join(unknown)}{near}')
    return {name: _typed(name, value, hints[name]) for name, value in values.items()}


def _typed(name: str, value: Any, kind: Any) -> Any:
    """A value from JSON or Python as its field has it; scalars of NumPy count as those they are."""
    if isinstance(kind, types.GenericAlias):
        is_list = isinstance(value, list | tuple)
        value = tuple(map(_plain, value)) if is_list else value
        fits = is_list and all(type(part) is int for part in value)
    else:
        value = _plain(value)
        fits = type(value) is kind or (kind is float and type(value) is int)
    if not fits:
        raise ValueError(f'{name} {value!r} is not of type {getattr(kind, "__name__", kind)}')
    return value


def _plain(value: Any) -> Any:
    return value.item() if isinstance(value, np.generic) else value
