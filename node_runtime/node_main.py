"""The `main` of every node: arguments, signals, rclpy, and how a process ends."""

from __future__ import annotations

import ctypes
import math
import os
import pkgutil
import re
import signal
import struct
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, MutableMapping, Sequence
from contextlib import contextmanager, suppress
from itertools import pairwise
from types import FrameType
from typing import TYPE_CHECKING, Any

from msgs_spec.parameters import usage
from msgs_spec.text import one_line
from msgs_spec.topics import NAMESPACE
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    UsageError,
    complain,
    make_output_usable,
    require_extra,
    run_command,
)
from node_runtime.ros import keep_discovery_local, leave_out_shared_memory
from node_runtime.signals import available_signals

if TYPE_CHECKING:
    from rclpy.node import Node

# Time limit for destroying a node; 0.3 s are usual.
_DESTROY_SECONDS = 10.0
# Signals within this many seconds count as one.
_AT_ONCE = 1.0
# Constants of glibc's <time.h> and <signal.h>.
_CLOCK_MONOTONIC = 1
_SIGEV_THREAD = 2
# Characters of an error line.
_LONGEST_LINE = 1000


class NodeFailure(CommandError):
    """The node cannot continue; the message is one line with the reason."""


class StopSignals:
    """Records SIGINT, SIGTERM and SIGHUP, so that a node finishes its tick before it stops.

    rclpy's own handlers would invalidate the context in the middle of a tick and lose the last
    messages. An instance that is created outside of the main thread records nothing.

    Attributes:
        received: Name of the last signal, or None.
        second_ends: Whether another signal, more than a second later, ends the process at once.
            Set it for nodes that run third-party code, which may never return.
    """

    def __init__(self) -> None:
        self.received: str | None = None
        self.second_ends = False
        self._received_at = -math.inf
        for number in available_signals([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]):
            signal.signal(number, self._handle)

    def __bool__(self) -> bool:
        """Return whether a signal was received."""
        return self.received is not None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        is_second = self.received is not None
        if self.second_ends and is_second and time.monotonic() - self._received_at > _AT_ONCE:
            signal.signal(number, signal.SIG_DFL)
            signal.raise_signal(number)
        self.received = signal.Signals(number).name
        self._received_at = time.monotonic()

    def watch(self) -> Callable[[], bool]:
        """Return a function that returns whether a signal arrived a second or more after this call.

        Signals before that do not count, because shells and supervisors may send several at once.
        """
        earliest = time.monotonic() + _AT_ONCE
        return lambda: self._received_at >= earliest


def node_main(
    name: str,
    summary: str,
    node_class: str,
    args: list[str] | None = None,
    shared_memory: bool = False,
    second_signal_ends: bool = False,
) -> int:
    """Run a node of this project as a process, or print its help; return the exit code.

    The help begins with `summary`. `node_class` is `package.module:Class`, a class with the methods
    `run(stop)` and `destroy_node()`. A ValueError of its constructor is reported as wrong usage.
    For `shared_memory` see `run_node`; for `second_signal_ends` see `StopSignals.second_ends`.
    """
    given = sys.argv[1:] if args is None else args
    if '-h' in given or '--help' in given:
        return run_command(name, lambda: print(usage(name, summary)) or EXIT_SUCCESS)

    def run(stop: StopSignals) -> None:
        stop.second_ends = second_signal_ends
        make_node: Callable[[], Any] = pkgutil.resolve_name(node_class)
        if stop:
            return
        try:
            node = make_node()
        except ValueError as error:
            raise UsageError(one_line(error, _LONGEST_LINE)) from error
        try:
            node.run(stop)
        finally:
            destroy(node)

    return run_node(name, run, args, shared_memory)


def destroy(node: Node, exit_code: int | None = None) -> None:
    """Destroy a node; end the process with `exit_code` if that takes longer than 10 s.

    The default code is 0; while an exception is handled, it is the exception's `exit_code`, or 1.
    """
    error = sys.exception()
    if exit_code is None:
        exit_code = EXIT_SUCCESS if error is None else getattr(error, 'exit_code', EXIT_FAILURE)
    with ends_within(_DESTROY_SECONDS, exit_code):
        node.destroy_node()


@contextmanager
def ends_within(seconds: float, exit_code: int) -> Iterator[None]:
    """End the process with `exit_code` if the block takes longer than `seconds`.

    Fast DDS 2.14 can spin for minutes while a participant is deleted (eProsima/Fast-DDS issue
    6513), and rclpy holds the interpreter meanwhile. No Python thread or signal handler runs then,
    but a timer of the C library does. Flushes stdout and stderr before the block. Needs glibc.
    """
    for stream in filter(None, (sys.stdout, sys.stderr)):
        with suppress(OSError, ValueError):
            stream.flush()
    library, timer = ctypes.CDLL(None), ctypes.c_void_p()
    # `_exit` takes its argument where a notification function finds the value.
    leave = ctypes.cast(library._exit, ctypes.c_void_p).value
    # `struct sigevent` of 64-bit glibc: value, signal, notification, function, attributes.
    event = struct.pack('PiiPP32x', exit_code, 0, _SIGEV_THREAD, leave, 0)
    is_armed = (
        hasattr(library, 'gnu_get_libc_version')
        and library.timer_create(_CLOCK_MONOTONIC, event, ctypes.byref(timer)) == 0
    )
    if is_armed:
        # `struct itimerspec`: the interval and the first expiry, in seconds and nanoseconds.
        expiry = struct.pack('4l', 0, 0, int(seconds), int(seconds % 1 * 1e9))
        library.timer_settime(timer, 0, expiry, None)
    try:
        yield
    finally:
        if is_armed:
            library.timer_delete(timer)


def run_node(
    name: str,
    run: Callable[[StopSignals], None],
    args: list[str] | None = None,
    shared_memory: bool = False,
) -> int:
    """Initialise rclpy, run a node and return the exit code of the process.

    Args:
        run: Runs until its work is done or a signal is recorded.
        shared_memory: Whether Fast DDS may use shared memory, where a stopped subscriber can block
            the node. Set it for nodes that send pictures and that `sim_node` never waits for.

    Returns:
        0 after the work is done or a signal; 2 for wrong usage; 1 for a failure. Errors print one
        line on stderr.
    """
    make_output_usable()
    # Before the imports below, which take seconds.
    stop = StopSignals()
    keep_discovery_local()
    find_place_for_logs()
    if not shared_memory:
        leave_out_shared_memory()
    try:
        require_extra('ros')
    except UsageError as error:
        complain(name, error)
        return error.exit_code
    import rclpy
    from rclpy.exceptions import InvalidParameterTypeException, ROSInterruptException
    from rclpy.signals import SignalHandlerOptions

    try:
        _reject_arguments(sys.argv[1:] if args is None else args)
        _initialise(rclpy.init, args, SignalHandlerOptions.NO)
        run(stop)
    except CommandError as error:
        complain(name, error)
        return error.exit_code
    except InvalidParameterTypeException as error:
        # From a parameter of ROS itself, such as use_sim_time.
        complain(name, error)
        return UsageError.exit_code
    except ROSInterruptException:
        return EXIT_SUCCESS
    finally:
        rclpy.try_shutdown()
    return EXIT_SUCCESS


def find_place_for_logs(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set `ROS_LOG_DIR` to the temporary folder if the home directory is not writable.

    Do nothing if `ROS_LOG_DIR` or `ROS_HOME` is set. ROS starts no node if it cannot write logs.
    """
    if any(map(environment.get, ('ROS_LOG_DIR', 'ROS_HOME'))):
        return
    home = environment.get('HOME', '')
    folder = os.path.abspath(os.path.join(home, '.ros', 'log'))
    while home and not os.path.exists(folder):
        folder = os.path.dirname(folder)
    if not home or not os.access(folder, os.W_OK):
        # Without a writable temporary folder, ROS prints the error itself.
        with suppress(FileNotFoundError):
            environment['ROS_LOG_DIR'] = tempfile.gettempdir()


def _initialise(init: Callable[..., None], args: list[str] | None, handlers: Any) -> None:
    try:
        init(args=args, signal_handler_options=handlers)
    except Exception as error:
        # rclpy raises several unrelated types for malformed `--ros-args`.
        line = one_line(error, _LONGEST_LINE)
        if type(error).__name__ == 'UnknownROSArgsError':
            line = (
                f'unknown after --ros-args: {line.strip("[]")}; a parameter is -p <name>:=<value>, '
                'a remapping -r <from>:=<to>'
            )
        raise UsageError(line) from None


def _reject_arguments(args: Sequence[str]) -> None:
    """Raise UsageError for an argument outside `--ros-args` or an invalid one inside.

    A parameter without a value and a wrong node name or namespace are invalid.
    """
    inside = False
    for before, arg in pairwise(['', *args]):
        if arg == '--ros-args':
            inside = True
        elif arg == '--':
            inside = False
        elif not inside:
            raise UsageError(
                f'unknown argument {arg!r}; parameters are given as --ros-args -p <name>:=<value>, '
                'or as <name>:=<value> alone after `fetch_hand_sim sim`, `policy`, ...'
            )
        elif before in ('-p', '--param') and arg.partition(':=')[1:] == (':=', ''):
            raise UsageError(f'{arg} has no value; an empty text is given as {arg}"\'\'"')
        elif re.match('(.*:)?__(ns|node):=', arg) and not NAMESPACE.fullmatch(
            arg.partition(':=')[2].removeprefix('/')
        ):
            raise UsageError(
                f'{arg[:80]!r} given; allowed: letters, digits and _, as a namespace also several '
                'such names with / between, none of which begins with a digit'
            )
