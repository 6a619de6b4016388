"""Text of error messages: one safe line, suggestions for misspelt names, shortened lists."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, TypeVar

Name = TypeVar('Name', bound=str)
# Maximum number of characters of a received name in an error.
_SHOWN = 40


def did_you_mean(given: str, allowed: Iterable[str] | Mapping[str, str]) -> str:
    """Return `; did you mean 'task'?` for a misspelt name, or '' if no allowed name is similar.

    If `allowed` is a mapping, the suggestion is the value of the most similar key.
    """
    meanings = allowed if isinstance(allowed, Mapping) else {name: name for name in allowed}
    by_lower = {name.lower(): meant for name, meant in meanings.items() if name}
    found = difflib.get_close_matches(given.lower(), by_lower, n=1)
    return f'; did you mean {by_lower[found[0]]!r}?' if found else ''


def one_of(given: object, allowed: Sequence[Name], meaning: str) -> Name:
    """Return the name in `allowed` that equals `given`; otherwise raise ValueError.

    The error is `<meaning> '<given>'; allowed: <names>`, for example `task 'x'; allowed: a, b`.
    """
    for name in allowed:
        if given == name:
            return name
    hint = did_you_mean(str(given)[:_SHOWN], allowed)
    shown = one_line(given, _SHOWN)
    raise ValueError(f'{meaning} {shown!r}; allowed: {", ".join(map(str, allowed))}{hint}')


def entries(owner: str, values: Any, allowed: Sequence[str]) -> dict[str, Any]:
    """Return the mapping `values` as a dictionary, if all its keys are in `allowed`.

    For other keys or another type, raise ValueError; its text begins with the name `owner`.
    """
    if not isinstance(values, Mapping):
        raise ValueError(
            f'{owner}: {one_line(values, _SHOWN)!r} given; allowed: a mapping of '
            f'{", ".join(allowed)}'
        )
    return {one_of(name, allowed, f'{owner} has no'): value for name, value in values.items()}


def first_of(names: Sequence[str], most: int) -> str:
    """Return at most `most` names as text, with the number of the others: `a, b and 3 more`."""
    rest = f' and {len(names) - most} more' if len(names) > most else ''
    return f'{", ".join(names[:most])}{rest}'


def counted(count: int, noun: str) -> str:
    """Return a number with its noun, such as `1 success` or `2 successes`."""
    plural = 'es' if noun.endswith('s') else 's'
    return f'{count} {noun}{"" if count == 1 else plural}'


def printable(text: str) -> str:
    """Return a text with unprintable characters, such as line breaks, as escape sequences."""
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def one_line(text: object, longest: int = 200) -> str:
    """Return a text or an error as one printable line, cut after `longest` characters.

    Line breaks become spaces. An error without a message becomes the name of its type.
    """
    words = ' '.join(str(text).split())
    if not words and isinstance(text, BaseException):
        words = type(text).__name__
    return printable(words[:longest])[:longest]
