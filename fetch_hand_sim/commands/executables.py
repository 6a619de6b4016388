"""The executables of this package, found through its entry points and never imported.

So a robot can start what commands it without knowing who that is.
"""

from __future__ import annotations

import sys
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points

from node_runtime import signals
from node_runtime.command_line import UsageError

_DISTRIBUTION = 'fetch_hand_sim'
_ACTORS = 'fetch_hand_sim.actors'
_PARENT = signals.__name__


class UnknownExecutableError(UsageError):
    """There is no such executable; the message is one line that says which there are."""


def find_executable(name: str) -> EntryPoint:
    """Returns the entry point of an executable such as `sim_node`.

    Raises:
        UnknownExecutableError: If the package is not installed or has no such executable.
    """
    try:
        points = distribution(_DISTRIBUTION).entry_points.select(group='console_scripts')
    except PackageNotFoundError:
        raise UnknownExecutableError(f'{_DISTRIBUTION} is not installed: pip install .') from None
    if name not in points.names:
        known = ', '.join(sorted(points.names))
        raise UnknownExecutableError(f'no executable {name!r}; installed: {known}')
    return points[name]


def executable(name: str, parent: int | None = None) -> list[str]:
    """Returns the command that runs an executable with this interpreter, ready for arguments.

    Args:
        name: Of the executable.
        parent: Id of the process that starts it, if it is to end with that one.

    Raises:
        UnknownExecutableError: If there is none of that name.
    """
    point = find_executable(name)
    function = f'__import__({point.module!r}, fromlist=["_"]).{point.attr}'
    # Before anything that takes long to import.
    first = '' if parent is None else f'import {_PARENT}; {_PARENT}.end_with_parent({parent}); '
    # As an installed executable: modules of the working directory do not come first.
    return [sys.executable, '-P', '-c', f'{first}import sys; sys.exit({function}())']


def is_actor_shipped(task: str) -> bool:
    """Whether an installed package ships an actor for a task.

    Each names, in the entry point group `fetch_hand_sim.actors`, a function that returns its actors
    by task.
    """
    return any(task in point.load()() for point in entry_points(group=_ACTORS))
