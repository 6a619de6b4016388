"""What somebody who mistyped a name probably meant."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping


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
