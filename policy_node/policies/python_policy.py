"""Policies of somebody's own code: `module:function`, whatever library they are of.

The function gets the name of the task and returns what acts: an object with `predict`, as models of
Stable-Baselines3 have, or a function from one observation to one action.
"""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Callable, Iterator
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from msgs_spec.text import one_line
from policy_node.policies.policy import LoadedPolicy, Observation, Policy

_NAME = re.compile(r'[^\W\d]\w*(\.[^\W\d]\w*)*:[^\W\d]\w*')


class FunctionPolicy:
    """A function as a policy; a batch is asked about row by row.

    Args:
        act: From an observation, a mapping of arrays (size,), to an action (action size,).
    """

    def __init__(self, act: Callable[[Observation], Any]) -> None:
        self._act = act

    def predict(
        self,
        observation: Observation,
        state: Any = None,
        episode_start: Any = None,
        deterministic: bool = True,
    ) -> tuple[NDArray[Any], None]:
        """Returns actions (..., action size) in [-1, 1] for one observation or a batch."""
        del state, episode_start, deterministic
        parts = {name: np.asarray(values) for name, values in observation.items()}
        leading = parts['observation'].shape[:-1]
        if not leading:
            return np.asarray(self._act(parts)), None
        rows = [
            self._act({name: values[index] for name, values in parts.items()})
            for index in np.ndindex(leading)
        ]
        return np.reshape(np.asarray(rows), (*leading, -1)), None


def is_python_name(name: str) -> bool:
    """Whether this names a function of a module, such as `my_policies.reach:make`."""
    return _NAME.fullmatch(name) is not None


@contextlib.contextmanager
def working_directory_first() -> Iterator[None]:
    """Has modules of the working directory found first; afterwards they are found last.

    Executables have their own folder first; what is imported later finds its own module again.
    """
    here = os.getcwd()
    sys.path.insert(0, here)
    try:
        yield
    finally:
        sys.path.remove(here)
        sys.path.append(here)


def load_python(name: str, task: str) -> LoadedPolicy:
    """Imports a module, also from the working directory, and has its function make a policy.

    Args:
        name: `module:function`.
        task: What the function is called with.

    Raises:
        ValueError: If there is no such module or function, or it fails; one line says why.
    """
    module_name, _, function_name = name.partition(':')
    try:
        with working_directory_first():
            made = getattr(import_module(module_name), function_name)(task)
        control_hz = getattr(made, 'control_hz', None)
        control_hz = None if control_hz is None else float(control_hz)
    except (Exception, SystemExit) as error:
        # It may raise anything, as it is imported and as it is called.
        raise ValueError(
            f'{name} makes no policy: {type(error).__name__}: {one_line(error)}'
        ) from None
    if not (callable(made) or hasattr(made, 'predict')):
        raise ValueError(
            f'{name} makes {one_line(type(made).__name__)}; allowed: an object with predict, or a '
            'function from observation to action'
        )
    policy: Policy = made if hasattr(made, 'predict') else FunctionPolicy(made)
    return LoadedPolicy(policy, task, name, control_hz)
