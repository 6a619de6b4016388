"""What arguments may be: refused by name before a library trips over them."""

from __future__ import annotations

import numpy as np


def require_whole(name: str, value: object) -> None:
    """Refuses what is no whole number.

    Raises:
        ValueError: If it is none; True and False are none either.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise ValueError(f'{name} must be a whole number, not {value!r}')
