"""Configurations that are refused."""

from __future__ import annotations

import pytest

from policy_node.training.configuration.recipes import recipe_config


def assert_refused(message: str, **changes: object) -> None:
    """FetchReach with these fields is refused in one line that matches a pattern."""
    with pytest.raises(ValueError, match=message) as raised:
        recipe_config('FetchReach', 'best', **changes)
    assert '\n' not in str(raised.value)
