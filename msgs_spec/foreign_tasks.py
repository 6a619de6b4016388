"""Tasks of other packages, named by entry points.

In the group `fetch_hand_sim_tasks.specification` an entry point gives a `TaskSpec` of its own name,
without importing MuJoCo; in the group `fetch_hand_sim_tasks.simulation` one of the same name gives
the class that simulates it. A package that is broken costs one warning and its own task, no more.
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from msgs_spec.text import one_line

SPECS = 'fetch_hand_sim_tasks.specification'
SIMULATIONS = 'fetch_hand_sim_tasks.simulation'

_Spec = TypeVar('_Spec')
_LOGGER = logging.getLogger(__name__)
# What policies do without; it asks for the tasks itself.
_SIMULATOR = 'fetch_hand_sim'
# Whose the tasks are that were taken.
_PACKAGES: dict[str, str] = {}


def foreign_tasks(accept: Callable[[str, Any], _Spec]) -> dict[str, _Spec]:
    """The tasks of other packages, by name.

    Args:
        accept: Returns what an entry point of a name gave, or raises a `ValueError` saying what is
            wrong with it.
    """
    tasks: dict[str, _Spec] = {}
    for entry_point in entry_points(group=SPECS):
        name = entry_point.name
        try:
            if name in tasks:
                raise ValueError('another package has a task of this name')
            tasks[name] = accept(name, _loaded(entry_point))
            _PACKAGES[name] = _package(entry_point)
        except (Exception, SystemExit) as error:  # whatever a package of somebody else does
            _LOGGER.warning('task %s is left out: %s', name, _what_failed(entry_point, error))
    return tasks


def _loaded(entry_point: EntryPoint) -> Any:
    """What an entry point gives; a warning where that brings the simulation with it."""
    is_there = _SIMULATOR in sys.modules
    given = entry_point.load()
    if not is_there and _SIMULATOR in sys.modules:
        _LOGGER.warning(
            'task %s: %s: %s imports %s, which only its simulation may',
            entry_point.name,
            _package(entry_point),
            entry_point.value,
            _SIMULATOR,
        )
    return given


def foreign_simulation(name: str) -> Any:
    """The class that simulates a task of another package.

    Raises:
        ValueError: If no package has one, or it cannot be imported; the message is one line.
    """
    found = entry_points(group=SIMULATIONS, name=name)
    # That of the package whose task was taken, where several have one of the name.
    own = [each for each in found if _package(each) == _PACKAGES.get(name)]
    for entry_point in own or found:
        try:
            return entry_point.load()
        except (Exception, SystemExit) as error:
            raise ValueError(f'task {name}: {_what_failed(entry_point, error)}') from error
    raise ValueError(
        f'task {name} has no simulation: no installed package names one in the entry points '
        f'{SIMULATIONS!r}'
    )


def _package(entry_point: EntryPoint) -> str:
    return entry_point.dist.name if entry_point.dist is not None else 'a package'


def _what_failed(entry_point: EntryPoint, error: BaseException) -> str:
    return f'{_package(entry_point)}: {entry_point.value}: {one_line(error, longest=1000)}'
