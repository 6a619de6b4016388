"""The few lines of rclpy that both nodes share. Nothing else in `msgs_spec` needs ROS."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Callable, Sequence
from importlib import import_module
from types import FrameType
from typing import TYPE_CHECKING, Any

from msgs_spec.parameters import ParameterSpec, descriptor, validate

if TYPE_CHECKING:
    from rclpy.node import Node

EXIT_SUCCESS, EXIT_FAILURE, EXIT_USAGE = 0, 1, 2


class UsageError(Exception):
    """The user asked for what is not possible; the message is one line that says what is."""


class NodeFailure(Exception):
    """The node cannot go on; the message is one line that says why."""


def ros_message_class(type_name: str) -> Any:
    """Returns rclpy's class of a message type such as `sensor_msgs/msg/JointState`."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


def declare_parameters(node: Node, specs: Sequence[ParameterSpec]) -> dict[str, Any]:
    """Declares parameters with description and range and returns their values.

    Raises:
        UsageError: If a value given at the start is not allowed.
    """
    return {spec.name: _declare(node, spec) for spec in specs}


def _declare(node: Node, spec: ParameterSpec) -> Any:
    from rclpy.exceptions import InvalidParameterTypeException, InvalidParameterValueException

    try:
        value = node.declare_parameter(spec.name, spec.default, descriptor(spec)).value
        validate(spec, value)
    except (InvalidParameterTypeException, InvalidParameterValueException) as error:
        line = ' '.join(str(error).split())
        raise UsageError(f'{line}; allowed: {spec.allowed}') from None
    except ValueError as error:
        raise UsageError(str(error)) from None
    return float(value) if spec.type == 'double' else value


class StopSignals:
    """Turns SIGINT and SIGTERM into a flag, so that a tick in progress is finished first.

    rclpy's own handlers would invalidate the context in the middle of a tick, and the last messages
    with it.
    """

    def __init__(self) -> None:
        """Takes the signals over; only the main thread can."""
        self.received: str | None = None
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def __bool__(self) -> bool:
        """Whether to stop."""
        return self.received is not None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.received = signal.Signals(number).name


def run_node(name: str, run: Callable[[StopSignals], None], args: list[str] | None = None) -> int:
    """Initialises rclpy, runs a node and returns the process's exit code.

    Args:
        name: Name of the executable, for error lines.
        run: Runs until it is done or the signals say stop.
        args: Command line; None for that of the process.

    Returns:
        0 for a normal end, also by signal; 2 for bad usage; 1 for a failure. Errors of both kinds
        are one line on stderr.
    """
    import rclpy
    from rclpy.exceptions import ROSInterruptException
    from rclpy.signals import SignalHandlerOptions

    keep_discovery_local()
    stop = StopSignals()
    try:
        _refuse_plain_arguments(sys.argv[1:] if args is None else args)
        _initialise(rclpy.init, args, SignalHandlerOptions.NO)
        run(stop)
    except UsageError as error:
        print(f'{name}: {error}', file=sys.stderr)
        return EXIT_USAGE
    except NodeFailure as error:
        print(f'{name}: {error}', file=sys.stderr)
        return EXIT_FAILURE
    except ROSInterruptException:
        return EXIT_SUCCESS
    finally:
        rclpy.try_shutdown()  # type: ignore[attr-defined]
    return EXIT_SUCCESS


def keep_discovery_local() -> None:
    """Keeps robots on this machine unless the user chose a discovery range."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')


def _initialise(init: Callable[..., None], args: list[str] | None, handlers: Any) -> None:
    try:
        init(args=args, signal_handler_options=handlers)
    except Exception as error:
        # rclpy raises several unrelated types for malformed `--ros-args`.
        raise UsageError(' '.join(str(error).split())) from None


def _refuse_plain_arguments(args: Sequence[str]) -> None:
    """Rejects what stands outside of `--ros-args ... --`, which rclpy would ignore."""
    inside = False
    for arg in args:
        if arg == '--ros-args':
            inside = True
        elif arg == '--':
            inside = False
        elif not inside:
            raise UsageError(
                f'unknown argument {arg!r}; parameters are given as --ros-args -p <name>:=<value>'
            )
