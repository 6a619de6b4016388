"""Third-party tasks, found by entry points.

An entry point of the group `fetch_hand_sim_tasks.specification` gives a `TaskSpec` of its own name,
without importing MuJoCo. An entry point of the same name in the group
`fetch_hand_sim_tasks.simulation` gives the class that simulates the task. A broken package costs
one warning and its own task; `fetch_hand_sim.simulation.check_task` finds subtle mistakes.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Collection
from dataclasses import replace
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from msgs_spec.task_types import TaskSpec
from msgs_spec.text import one_line

SPECS = 'fetch_hand_sim_tasks.specification'
SIMULATIONS = 'fetch_hand_sim_tasks.simulation'

_LOGGER = logging.getLogger(__name__)
# Names become Gymnasium ids and file names.
_NAME = re.compile(r'\w[\w.-]{0,63}')
# Package of each accepted task.
_PACKAGES: dict[str, str] = {}


def foreign_tasks(known: Collection[str]) -> dict[str, TaskSpec]:
    """Return the third-party tasks by name; warn about each that is left out.

    Args:
        known: Names that third-party tasks must not take.
    """
    tasks: dict[str, TaskSpec] = {}
    for entry_point in entry_points(group=SPECS):
        name = entry_point.name
        try:
            if name in tasks or name in known:
                raise ValueError('another task has this name')
            tasks[name] = _accept(name, entry_point.load())
            _PACKAGES[name] = _package(entry_point)
        except (Exception, SystemExit) as error:  # third-party code
            _LOGGER.warning('task %s is left out: %s', name, _failure(entry_point, error))
    return tasks


def _accept(name: str, spec: Any) -> TaskSpec:
    """Return a third-party specification; raise `ValueError` if it cannot be listed."""
    if not isinstance(spec, TaskSpec):
        raise ValueError(f'{type(spec).__name__} given; allowed: a TaskSpec')
    if spec.name != name:
        raise ValueError(f'its TaskSpec has the name {spec.name!r}; allowed: {name!r}')
    if not _NAME.fullmatch(name):
        raise ValueError(f'name {name!r:.80}; allowed: up to 64 letters, digits, _, - and .')
    # Specifications are keys of caches.
    hash(spec)
    # A copy of a reference task (`dataclasses.replace`) would else take over its environment id.
    return replace(spec, reference_id=None)


def foreign_simulation(name: str) -> Any:
    """Return the class that simulates a third-party task.

    Raises:
        ValueError: If no package has one, or it cannot be imported.
    """
    found = entry_points(group=SIMULATIONS, name=name)
    # Several packages may use the name: prefer the package of the specification.
    own = [each for each in found if _package(each) == _PACKAGES.get(name)]
    for entry_point in own or found:
        try:
            return entry_point.load()
        except (Exception, SystemExit) as error:
            raise ValueError(f'task {name}: {_failure(entry_point, error)}') from error
    raise ValueError(
        f'task {name} has no simulation: no installed package has an entry point of this name in '
        f'{SIMULATIONS!r}'
    )


def _package(entry_point: EntryPoint) -> str:
    return entry_point.dist.name if entry_point.dist is not None else 'a package'


def _failure(entry_point: EntryPoint, error: BaseException) -> str:
    return f'{_package(entry_point)}: {entry_point.value}: {one_line(error, longest=1000)}'
