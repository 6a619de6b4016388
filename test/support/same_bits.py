"""Equality to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np


def assert_same(first: Any, second: Any) -> None:
    """Compare numbers and arrays, also in dictionaries and lists."""
    if isinstance(first, dict):
        assert first.keys() == second.keys()
        first, second = [*first.values()], [second[name] for name in first]
    if isinstance(first, list | tuple) or (np.ndim(first) and first.dtype == object):
        for one, other in zip(first, second, strict=True):
            assert_same(one, other)
    else:
        one, other = np.asarray(first), np.asarray(second)
        assert (one.shape, one.dtype) == (other.shape, other.dtype)
        assert one.tobytes() == other.tobytes()
