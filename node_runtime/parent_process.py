"""The end of a process together with the one that started it, however that one ends."""

from __future__ import annotations

import ctypes
import os
import signal
import sys

# The option of prctl(2), `PR_SET_PDEATHSIG`.
_SET_PARENT_DEATH_SIGNAL = 1


def end_with_parent(parent: int) -> None:
    """Has this process get SIGTERM as soon as the one that started it is gone.

    For processes out of the group of their parent, which Ctrl-C and a closed terminal do not reach.
    On other systems than Linux nothing happens.

    Args:
        parent: Id of the process that started this one.
    """
    if sys.platform != 'linux':
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGTERM)
    # It may have ended before the line above.
    if os.getppid() != parent:
        os.kill(os.getpid(), signal.SIGTERM)
