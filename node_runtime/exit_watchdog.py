"""The end of a process that a library does not let go.

Fast DDS 2.14 can spin for minutes where a participant is deleted while another one comes or goes
(eProsima/Fast-DDS issue 6513: it waits for a callback without ever giving up the lock that the
callback needs), and rclpy holds the interpreter meanwhile, so that neither a thread nor a signal
handler of Python gets a turn. A timer of the C library does.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

_CLOCK_MONOTONIC = 1
_SIGEV_THREAD = 2


class _SignalEvent(ctypes.Structure):
    """`struct sigevent` of glibc on 64-bit machines: 64 bytes."""

    _fields_ = (
        ('value', ctypes.c_void_p),
        ('signal', ctypes.c_int),
        ('notify', ctypes.c_int),
        ('function', ctypes.c_void_p),
        ('attributes', ctypes.c_void_p),
        ('padding', ctypes.c_char * 32),
    )


class _TimerSpec(ctypes.Structure):
    """`struct itimerspec`: seconds and nanoseconds of the interval and of the first expiry."""

    _fields_ = tuple(
        (name, ctypes.c_long) for name in ('interval_s', 'interval_ns', 'first_s', 'first_ns')
    )


@contextmanager
def ends_within(seconds: float, exit_code: int) -> Iterator[None]:
    """Ends the process with `exit_code` where what is done inside takes longer than `seconds`.

    Nothing is flushed but standard output and error, and these before. It works where the C library
    is glibc; elsewhere nothing happens.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):
        # Whoever read it may be gone.
        with suppress(OSError, ValueError):
            stream.flush()
    disarm = _arm(seconds, exit_code)
    try:
        yield
    finally:
        disarm()


def _arm(seconds: float, exit_code: int) -> Callable[[], None]:
    library = ctypes.CDLL(None)
    if not sys.platform.startswith('linux') or not hasattr(library, 'gnu_get_libc_version'):
        return lambda: None
    # `_exit` takes its argument where a notification function finds the value.
    leave = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _SignalEvent(value=exit_code, notify=_SIGEV_THREAD, function=leave)
    timer = ctypes.c_void_p()
    if library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) != 0:
        return lambda: None
    first_s = int(seconds)
    first = _TimerSpec(first_s=first_s, first_ns=int((seconds - first_s) * 1e9))
    library.timer_settime(timer, 0, ctypes.byref(first), None)
    return lambda: library.timer_delete(timer)
