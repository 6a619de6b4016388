"""The `main` of every node: arguments, signals, rclpy, and how a process ends."""

from __future__ import annotations

import math
import os
import signal
import sys
import tempfile
import time
from collections.abc import Callable, MutableMapping, Sequence
from contextlib import suppress
from itertools import pairwise
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from msgs_spec.parameters import usage
from msgs_spec.text import one_line
from node_runtime.command_line import (
    EXIT_FAILURE,
    EXIT_SUCCESS,
    CommandError,
    UsageError,
    complain,
    heard,
    make_output_usable,
    require_extra,
    run_command,
)
from node_runtime.exit_watchdog import ends_within
from node_runtime.transport import keep_discovery_local, leave_out_shared_memory

if TYPE_CHECKING:
    from rclpy.node import Node

# Enough for any node on a busy machine: 0.3 s are usual.
_DESTROY_SECONDS = 10.0
# Seconds within which several signals are one.
_AT_ONCE = 1.0


class NodeFailure(CommandError):
    """The node cannot go on; the message is one line that says why."""


class StopSignals:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag, so that a tick in progress is finished first.

    SIGHUP, which a closed terminal sends, only where it is not ignored, as `nohup` has it.

    rclpy's own handlers would invalidate the context in the middle of a tick, and the last messages
    with it. A thread other than the main one hears of no signal.

    Attributes:
        received: Name of the signal that came, None if none did.
        second_ends: Whether another one, a second or more after it, ends the process at once: of
            nodes that call code of somebody else's, which may never come back.
    """

    def __init__(self) -> None:
        self.received: str | None = None
        self.second_ends = False
        self._received_at = -math.inf
        for number in heard([signal.SIGINT, signal.SIGTERM, signal.SIGHUP]):
            signal.signal(number, self._handle)

    def __bool__(self) -> bool:
        """Whether to stop."""
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
        """Returns what says whether another signal has come, a second or more from now.

        Whoever ends a process may send several at once.
        """
        earliest = time.monotonic() + _AT_ONCE
        return lambda: self._received_at >= earliest


class RunnableNode(Protocol):
    """A node that runs until it is done or told to stop."""

    def run(self, stop: StopSignals) -> None:
        """Runs."""

    def destroy_node(self) -> None:
        """Closes its topics and services."""


def node_main(
    name: str,
    summary: str,
    load: Callable[[], Callable[[], RunnableNode]],
    args: list[str] | None = None,
    shared_memory: bool = False,
    second_signal_ends: bool = False,
) -> int:
    """Runs a node of `NODES` as a process, or prints its help; returns the exit code of `run_node`.

    Args:
        name: Name of the executable and of the node.
        summary: What it is, in a line.
        load: Imports the class of the node, which may take long.
        args: Command line; None for that of the process.
        shared_memory: As in `run_node`.
        second_signal_ends: As `StopSignals.second_ends`.
    """
    given = sys.argv[1:] if args is None else args
    if '-h' in given or '--help' in given:
        return run_command(name, lambda: _print_usage(name, summary))

    def run(stop: StopSignals) -> None:
        stop.second_ends = second_signal_ends
        _run(load, stop)

    return run_node(name, run, args, shared_memory)


def _print_usage(name: str, summary: str) -> int:
    print(usage(name, summary))
    return EXIT_SUCCESS


def _run(load: Callable[[], Callable[[], RunnableNode]], stop: StopSignals) -> None:
    make_node = load()
    if stop:
        return
    node = make_node()
    try:
        node.run(stop)
    finally:
        destroy(node)


def destroy(node: RunnableNode | Node, exit_code: int | None = None) -> None:
    """Destroys a node whose work is done; if that takes too long the process ends all the same.

    Args:
        node: Of a process that has nothing else to do.
        exit_code: What the process then ends with; None for 0, or the code of the error on its way.
    """
    error = sys.exception()
    if exit_code is None:
        exit_code = EXIT_SUCCESS if error is None else getattr(error, 'exit_code', EXIT_FAILURE)
    with ends_within(_DESTROY_SECONDS, exit_code):
        node.destroy_node()


def run_node(
    name: str,
    run: Callable[[StopSignals], None],
    args: list[str] | None = None,
    shared_memory: bool = False,
) -> int:
    """Initialises rclpy, runs a node and returns the process's exit code.

    Args:
        name: Name of the executable, for error lines.
        run: Runs until it is done or the signals say stop.
        args: Command line; None for that of the process.
        shared_memory: Whether readers that die may hold the node up, which `transport.py` explains:
            for nodes that send pictures and keep nobody waiting.

    Returns:
        0 for a normal end, also by signal; 2 for bad usage; 1 for a failure. Errors of both kinds
        are one line on stderr.
    """
    make_output_usable()
    # What follows takes long enough for people to change their mind.
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
        _refuse_arguments(sys.argv[1:] if args is None else args)
        _initialise(rclpy.init, args, SignalHandlerOptions.NO)
        run(stop)
    except CommandError as error:
        complain(name, error)
        return error.exit_code
    except InvalidParameterTypeException as error:
        # Of a parameter that is ROS's own, such as use_sim_time.
        complain(name, error)
        return UsageError.exit_code
    except ROSInterruptException:
        return EXIT_SUCCESS
    finally:
        rclpy.try_shutdown()
    return EXIT_SUCCESS


def find_place_for_logs(environment: MutableMapping[str, str] = os.environ) -> None:
    """Without a home that may be written to, as in many a container, ROS starts no node."""
    if any(map(environment.get, ('ROS_LOG_DIR', 'ROS_HOME'))):
        return
    home = environment.get('HOME', '')
    folder = os.path.abspath(os.path.join(home, '.ros', 'log'))
    while home and not os.path.exists(folder):
        folder = os.path.dirname(folder)
    if not home or not os.access(folder, os.W_OK):
        # Where not even that can be written, ROS says so.
        with suppress(FileNotFoundError):
            environment['ROS_LOG_DIR'] = tempfile.gettempdir()


def _initialise(init: Callable[..., None], args: list[str] | None, handlers: Any) -> None:
    try:
        init(args=args, signal_handler_options=handlers)
    except Exception as error:
        # rclpy raises several unrelated types for malformed `--ros-args`.
        line = one_line(error, longest=1000)
        if type(error).__name__ == 'UnknownROSArgsError':
            line = (
                f'unknown after --ros-args: {line.strip("[]")}; a parameter is -p <name>:=<value>, '
                'a remapping -r <from>:=<to>'
            )
        raise UsageError(line) from None


def _refuse_arguments(args: Sequence[str]) -> None:
    """Rejects what stands outside of `--ros-args ... --`, which rclpy would ignore.

    Also a parameter without a value, of which it would say `error not set`.
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
