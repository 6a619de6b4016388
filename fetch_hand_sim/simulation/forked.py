"""What a forked process must not free: batches whose threads stayed behind.

MuJoCo waits for the threads of a batch when it frees one, and a fork has none of them: it would
wait for ever, or end there.
"""

from __future__ import annotations

import ctypes
import os
import weakref

from mujoco.batch import Batch

_THREADED: weakref.WeakSet[Batch] = weakref.WeakSet()


def keep_in_forks(batch: Batch) -> None:
    """Has processes that are forked from this one keep a batch until they end."""
    if batch.nthread > 1:
        _THREADED.add(batch)


def _keep_all() -> None:
    for batch in _THREADED:
        # A list of them would be freed when the process ends.
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(batch))
    _THREADED.clear()


if hasattr(os, 'register_at_fork'):
    os.register_at_fork(after_in_child=_keep_all)
