"""Text of messages: one safe line, suggestions for misspelt names, shortened lists."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeVar

Name = TypeVar('Name', bound=str)
# Characters of a name from anywhere that are shown.
_SHOWN = 40


def did_you_mean(given: str, allowed: Iterable[str] | Mapping[str, str]) -> str:
    """Ends a line that refuses a name: `; did you mean 'task'?`, or nothing.

    Args:
        given: The name.
        allowed: Those that there are; of a mapping, its keys are what may be typed, and its values
            what is said instead.
    """
    meanings = allowed if isinstance(allowed, Mapping) else {name: name for name in allowed}
    by_lower = {name.lower(): meant for name, meant in meanings.items() if name}
    found = difflib.get_close_matches(given.lower(), by_lower, n=1)
    return f'; did you mean {by_lower[found[0]]!r}?' if found else ''


def one_of(given: str, allowed: Sequence[Name], meaning: str) -> Name:
    """Returns the name that was given, as one of those that there are.

    Args:
        given: The name, from anywhere.
        allowed: Those that there are.
        meaning: What it names, for the error.

    Raises:
        ValueError: If it is none of them, in one line.
    """
    for name in allowed:
        if given == name:
            return name
    raise ValueError(f'{meaning} {given[:_SHOWN]!r}; allowed: {", ".join(allowed)}')


def first_of(names: Sequence[str], most: int) -> str:
    """Returns the first of many names and how many are left out: `a, b and 3 more`."""
    rest = f' and {len(names) - most} more' if len(names) > most else ''
    return f'{", ".join(names[:most])}{rest}'


def printable(text: str) -> str:
    """Return text with the characters escaped that a terminal would interpret."""
    return ''.join(c if c.isprintable() else ascii(c)[1:-1] for c in text)


def one_line(text: object, longest: int = 200) -> str:
    """Return a text or an error as one line that is safe to print.

    An error without a message becomes the name of its type.

    Args:
        longest: Maximum number of characters of the line.
    """
    words = ' '.join(str(text).split())
    if not words and isinstance(text, BaseException):
        words = type(text).__name__
    return printable(words[:longest])[:longest]
