"""Set up MuJoCo: its warnings, timers, divergence counters and the threads of its batches."""

from __future__ import annotations

import ctypes
import functools
import logging
import os
import weakref
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco import mjtWarning
from mujoco.batch import Batch
from numpy.typing import NDArray

_LOGGER = logging.getLogger(__name__)
# MuJoCo resets a simulation after one of these warnings.
_THROWN_AWAY = [
    mjtWarning.mjWARN_BADQPOS.value,
    mjtWarning.mjWARN_BADQVEL.value,
    mjtWarning.mjWARN_BADQACC.value,
]
_THREADED: weakref.WeakSet[Batch] = weakref.WeakSet()


@functools.cache
def prepare_engine() -> None:
    """Send MuJoCo's warnings to `logging` and stop its step timers; repeated calls do nothing.

    A warning handler that is already installed stays.
    """
    if mujoco.get_mju_user_warning() is None:
        # The default handler writes MUJOCO_LOG.TXT into the working directory.
        mujoco.set_mju_user_warning(_log_warning)
    _stop_timers()


def _log_warning(message: str) -> None:
    _LOGGER.debug('MuJoCo: %s', message)


def _stop_timers() -> None:
    """Remove the clock that the Python bindings install to fill `MjData.timer`.

    MuJoCo reads it some twenty times per substep, 4-7 % of a step of these small models, and the
    bindings offer no way to switch it off. Trajectories do not depend on it.
    """
    for library in Path(mujoco.__file__).parent.glob('libmujoco*'):
        try:
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), 'mjcb_time')
        except (OSError, ValueError):
            continue
        clock.value = None


class DivergenceWatch:
    """Finds the simulations of a batch that MuJoCo reported as diverged since the last call."""

    def __init__(self, batch: Any) -> None:
        self._batch = batch
        self.forget()

    def forget(self) -> None:
        """Ignore all divergences so far."""
        # The last axis is (last info, number).
        self._batch.warning[:, _THROWN_AWAY] = 0

    def found(self) -> NDArray[np.bool_]:
        """Return which simulations diverged since the last call of this or `forget`, (N,)."""
        warning = self._batch.warning
        first, second, third = (warning[:, kind, 1] for kind in _THROWN_AWAY)
        lost = np.asarray(first + second + third > 0)
        if lost.any():
            # MuJoCo throws its counters away with the state: each loss is number one again.
            self.forget()
        return lost


def keep_in_forks(batch: Batch) -> None:
    """Keep a batch alive in forked processes until they end."""
    if batch.nthread > 1:
        _THREADED.add(batch)


def _keep_all() -> None:
    for batch in _THREADED:
        # A list of them would be freed when the process ends.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))
    _THREADED.clear()


if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=_keep_all)
