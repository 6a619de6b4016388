"""Two settings of MuJoCo that hold for the whole process."""

from __future__ import annotations

import ctypes
import functools
import logging
from pathlib import Path

import mujoco

_LOGGER = logging.getLogger(__name__)


@functools.cache
def prepare_engine() -> None:
    """Sends MuJoCo's warnings to `logging` and stops its step timers; repeated calls do nothing.

    A warning handler that somebody else has installed stays.
    """
    if mujoco.get_mju_user_warning() is None:
        # The default handler writes MUJOCO_LOG.TXT into the working directory.
        mujoco.set_mju_user_warning(_log_warning)
    _stop_timers()


def _log_warning(message: str) -> None:
    _LOGGER.debug('MuJoCo: %s', message)


def _stop_timers() -> None:
    """Removes the clock that the Python bindings install to fill `MjData.timer`.

    MuJoCo reads it some twenty times per substep, 4-7 % of a step of these small models, and the
    bindings offer no way to switch it off. Trajectories do not depend on it.
    """
    for library in Path(mujoco.__file__).parent.glob('libmujoco*'):
        try:
            clock = ctypes.c_void_p.in_dll(ctypes.CDLL(str(library)), 'mjcb_time')
        except (OSError, ValueError):
            continue
        clock.value = None
