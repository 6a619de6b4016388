"""Parametrisation of tests over tasks."""

from __future__ import annotations

import pytest

from msgs_spec.tasks import TASKS

# One task of each robot and kind of goal.
FAMILIES = ('FetchReach', 'FetchPickAndPlace', 'HandReach', 'HandManipulateEggFull')

# `make test` runs the families, `make test-release` the other tasks.
each_task = pytest.mark.parametrize(
    'task',
    [pytest.param(task, marks=[] if task in FAMILIES else [pytest.mark.release]) for task in TASKS],
)
