"""A time limit on the shutdown of a process.

Fast DDS 2.14 can spin for minutes while a participant is deleted (eProsima/Fast-DDS issue 6513),
and rclpy holds the interpreter meanwhile. No Python thread or signal handler runs then, but a timer
of the C library does. `faulthandler.dump_traceback_later` would work too, but its exit code is
always 1.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterator
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
    """End the process with `exit_code` if the body takes longer than `seconds`.

    Stdout and stderr are flushed before the body, all else is lost. Works with glibc only.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with suppress(OSError, ValueError):
            stream.flush()
    library = ctypes.CDLL(None)
    timer = ctypes.c_void_p()
    # `_exit` takes its argument where a notification function finds the value.
    leave = ctypes.cast(library._exit, ctypes.c_void_p)
    event = _SignalEvent(value=exit_code, notify=_SIGEV_THREAD, function=leave)
    is_armed = (
        hasattr(library, 'gnu_get_libc_version')
        and library.timer_create(_CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(timer)) == 0
    )
    if is_armed:
        first = _TimerSpec(first_s=int(seconds), first_ns=int(seconds % 1 * 1e9))
        library.timer_settime(timer, 0, ctypes.byref(first), None)
    try:
        yield
    finally:
        if is_armed:
            library.timer_delete(timer)
