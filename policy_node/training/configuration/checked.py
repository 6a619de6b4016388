"""Types of configuration fields: ranges and choices that their annotations declare."""

from __future__ import annotations

import dataclasses
import math
import types
import typing
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np


@dataclass(frozen=True, slots=True)
class Range:
    """Least and largest value of a number."""

    low: float
    high: float = math.inf

    def __str__(self) -> str:
        if self.high == math.inf:
            return f'{_number(self.low)} or more'
        return f'{_number(self.low)} ... {_number(self.high)}'


# Floats represent all whole numbers up to here.
LARGEST = 2**53

Share = Annotated[float, Range(0, 1)]
Below1 = Annotated[float, Range(0, 1 - 1e-6)]
Total = Annotated[int, Range(0)]
Count = Annotated[int, Range(0, 1024)]


class Checked:
    """A group of fields whose values are of their types and within their ranges.

    Attributes:
        marks: Flat fields, with their values, that a configuration with this group has.
    """

    __slots__ = ()
    marks: typing.ClassVar[dict[str, Any]] = {}

    def __post_init__(self) -> None:
        """Checks all fields.

        Raises:
            ValueError: One line names the field, its value and the allowed ones.
        """
        for name, kind in types_of(type(self)).items():
            require_within(name, getattr(self, name), kind)


_TYPES: dict[type, dict[str, Any]] = {}


def types_of(group: type) -> dict[str, Any]:
    """Return the annotated types of the fields of a group, by name."""
    if group not in _TYPES:
        _TYPES[group] = _find_types(group)
    return _TYPES[group]


def _find_types(group: Any) -> dict[str, Any]:
    hints = typing.get_type_hints(group, include_extras=True)
    return {each.name: hints[each.name] for each in dataclasses.fields(group)}


def range_of(kind: Any) -> Range | None:
    """Return the range of an annotated number, or None."""
    return kind.__metadata__[0] if typing.get_origin(kind) is Annotated else None


def choices_of(kind: Any) -> tuple[str, ...]:
    """Return the values of a literal type; of any other none."""
    return typing.get_args(kind) if typing.get_origin(kind) is Literal else ()


def plain_type(kind: Any) -> Any:
    """Return a type without its range; a literal is a `str`."""
    if typing.get_origin(kind) is Annotated:
        return typing.get_args(kind)[0]
    return str if choices_of(kind) else kind


def require_within(name: str, value: Any, kind: Any) -> None:
    """Reject a value that the type of its field does not allow.

    Raises:
        ValueError: One line names the field, the value and the allowed ones.
    """
    choices, limits = choices_of(kind), range_of(kind)
    if choices and value not in choices:
        raise ValueError(f'{name} {value!r:.80}; allowed: {", ".join(choices)}')
    if plain_type(kind) is int and abs(value) > LARGEST:
        raise ValueError(f'{name} is too large; allowed: up to {LARGEST}')
    if plain_type(kind) is float and not math.isfinite(value):
        raise ValueError(f'{name} {value} is no finite number')
    if limits and not limits.low <= value <= limits.high:
        raise ValueError(f'{name} {value}; allowed: {limits}')


def typed(name: str, value: Any, kind: Any) -> Any:
    """Return a value of Python or JSON with the type of its field.

    Scalars of NumPy count as Python's, lists as tuples, whole numbers as floats.

    Raises:
        ValueError: If it has another type.
    """
    plain, origin = plain_type(kind), typing.get_origin(plain_type(kind))
    if origin is tuple and isinstance(value, list | tuple):
        part = typing.get_args(plain)[0]
        return tuple(typed(name, each, part) for each in value)
    if origin is dict and isinstance(value, dict):
        return {str(key): typed(name, each, float) for key, each in value.items()}
    value = value.item() if isinstance(value, np.generic) else value
    if plain is float and type(value) is int and abs(value) <= LARGEST:
        return float(value)
    if type(value) is not plain:
        raise ValueError(f'{name} {value!r:.80} is not of type {type_name(plain)}')
    return value


def type_name(kind: Any) -> str:
    """Return the name of a type for messages."""
    return str(kind) if isinstance(kind, types.GenericAlias) else str(kind.__name__)


def _number(value: float) -> str:
    """Return a limit as text; a whole one to its last digit."""
    return f'{value:.6g}' if isinstance(value, float) else str(value)
