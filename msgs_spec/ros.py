"""All that the nodes share of rclpy. Nothing else in `msgs_spec` needs ROS."""

from __future__ import annotations

import os
import signal
import sys
import time
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import import_module
from itertools import pairwise
from types import FrameType
from typing import TYPE_CHECKING, Any, Protocol

from msgs_spec.command_line import EXIT_FAILURE, EXIT_SUCCESS, CommandError, complain, require_extra
from msgs_spec.command_line import UsageError as UsageError
from msgs_spec.last_resort import ends_within
from msgs_spec.parameters import ParameterSpec, unknown_parameter, usage, validate
from msgs_spec.topics import QosSpec
from msgs_spec.transport import keep_discovery_local, leave_out_shared_memory

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.clock import Clock
    from rclpy.executors import Executor
    from rclpy.node import Node
    from rclpy.parameter import Parameter
    from rclpy.publisher import Publisher
    from rclpy.qos import QoSProfile

# Seconds between looks at what no callback announces: signals, the graph.
BEAT = 0.1
# Seconds for what was said last to be heard.
_LAST_WORDS_SECONDS = 1.0
# Callbacks that an executor is asked for which does not say whether there are any.
_SERVED_BLINDLY = 10
# In which who is there is found for sure.
DISCOVERY_TIME = 2.0
# Seconds after which the graph has forgotten a process that was killed: until then it may stand
# beside its successor. DDS implementations take 20 s or less.
MEMORY_OF_THE_GRAPH = 25.0
# Enough for any node on a busy machine: 0.3 s are usual.
_DESTROY_SECONDS = 10.0


class NodeFailure(CommandError):
    """The node cannot go on; the message is one line that says why."""


def seldom(seconds: float) -> dict[str, Any]:
    """Arguments of a logger for a line that it says at most once in so many seconds.

    By rclpy's default, the system's clock, one that is set back would silence the line until that
    time comes again.
    """
    return {'throttle_duration_sec': seconds, 'throttle_time_source_type': _steady_clock()}


@cache
def _steady_clock() -> Clock:
    """Always the same: a logger takes no other for a line that it has said before."""
    from rclpy.clock import Clock
    from rclpy.clock_type import ClockType

    return Clock(clock_type=ClockType.STEADY_TIME)


def ros_message_class(type_name: str) -> Any:
    """Returns rclpy's class of a message type such as `sensor_msgs/msg/JointState`."""
    package, kind, name = type_name.split('/')
    return getattr(import_module(f'{package}.{kind}'), name)


def ros_service_class(type_name: str) -> Any:
    """Returns rclpy's class of a service type such as `std_srvs/srv/Trigger`."""
    return ros_message_class(type_name)


def rclpy_profile(spec: QosSpec) -> QoSProfile:
    """Returns the profile for rclpy's `create_publisher` and `create_subscription`."""
    from rclpy.qos import QoSDurabilityPolicy, QoSHistoryPolicy, QoSProfile, QoSReliabilityPolicy

    return QoSProfile(
        history=QoSHistoryPolicy.KEEP_LAST,
        depth=spec.depth,
        reliability=QoSReliabilityPolicy.get_from_short_key(spec.reliability),
        durability=QoSDurabilityPolicy.get_from_short_key(spec.durability),
    )


def count_publishers(node: Node, topic: str) -> int:
    """Returns how many publish a topic, under the name to which this node's is remapped."""
    return int(node.count_publishers(node.resolve_topic_name(topic)))


def await_acknowledgements(publishers: Iterable[Publisher]) -> None:
    """Gives what was said last a second to be heard; a killed subscriber never acknowledges."""
    from rclpy.duration import Duration

    deadline = time.monotonic() + _LAST_WORDS_SECONDS
    for publisher in publishers:
        left = max(0.0, deadline - time.monotonic())
        publisher.wait_for_all_acked(Duration(seconds=left))


class EventLoop:
    """Serves the callbacks of one node, from the thread that owns it.

    rclpy's EventsExecutor costs half of the wait-set one per message. It is used through
    `spin_once` alone, because its `spin` serves nothing in some builds. Releases before 7.1.4 lack
    it.

    Args:
        node: Whose callbacks.
    """

    def __init__(self, node: Node) -> None:
        self._node = node
        self._executor, self._is_queue = _make_executor()
        self._executor.add_node(node)

    def wait(self, seconds: float) -> None:
        """Serves one callback, or none within that time."""
        self._executor.spin_once(timeout_sec=seconds)

    def serve_pending(self, limit: int) -> None:
        """Serves what has been waiting, not what arrives meanwhile.

        Args:
            limit: Callbacks served at most. What comes in faster than it is served would otherwise
                take longer every time. A number and not a time, so that a busy machine changes
                nothing.
        """
        if not self._is_queue:
            # It says neither what waits nor whether it has served anything, and asking takes time.
            for _ in range(min(limit, _SERVED_BLINDLY)):
                self._executor.spin_once(timeout_sec=0.0)
            return
        # First in, first out: the mark comes last of what is there.
        reached: list[bool] = []
        self._executor.create_task(lambda: reached.append(True))
        for _ in range(limit):
            self._executor.spin_once(timeout_sec=0.0)
            if reached:
                return

    def close(self) -> None:
        """Gives the node back."""
        self._executor.remove_node(self._node)


def _make_executor() -> tuple[Executor, bool]:
    """Returns an executor and whether it serves a queue in order."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor(), False
    return EventsExecutor(), True


def declare_parameters(node: Node, specs: Sequence[ParameterSpec]) -> dict[str, Any]:
    """Declares parameters with description and range and returns their values.

    Parameters that it was given and does not have, or that have a new name, are named in a warning.

    Raises:
        UsageError: If a value given at the start is not allowed.
    """
    # rclpy has no public way to see what was given before it is declared.
    given: dict[str, Parameter] = node._parameter_overrides
    for spec in specs:
        if spec.former in given:
            node.get_logger().warning(f'parameter {spec.former} is now called {spec.name}')
            given.setdefault(spec.name, _renamed(given[spec.former], spec.name))
    values = {spec.name: _declare(node, spec, given.get(spec.name)) for spec in specs}
    for other in sorted(given):
        line = None if node.has_parameter(other) else unknown_parameter(specs, other)
        if line is not None:
            node.get_logger().warning(line)
    return values


def _renamed(parameter: Parameter, name: str) -> Parameter:
    from rclpy.parameter import Parameter

    return Parameter(name, parameter.type_, parameter.value)


def _declare(node: Node, spec: ParameterSpec, given: Parameter | None) -> Any:
    if given is not None:
        # Before rclpy does, whose lines do not say what is allowed.
        try:
            validate(spec, given.value)
        except ValueError as error:
            raise UsageError(str(error)) from None
    value = node.declare_parameter(spec.name, spec.default, descriptor(spec)).value
    if spec.is_path:
        return os.path.expanduser(value)
    return float(value) if spec.type == 'double' else value


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Returns the ROS descriptor.

    Doubles are typed dynamically, because ROS takes `1` on a command line for an integer and would
    refuse it.
    """
    from rcl_interfaces.msg import (
        FloatingPointRange,
        IntegerRange,
        ParameterDescriptor,
        ParameterType,
    )

    result = ParameterDescriptor(
        name=spec.name,
        type=getattr(ParameterType, f'PARAMETER_{spec.type.upper()}'),
        description=spec.description,
        additional_constraints=f'allowed: {spec.allowed}' if spec.choices or spec.or_zero else '',
        read_only=spec.read_only,
        dynamic_typing=spec.type == 'double',
    )
    lower = 0.0 if spec.or_zero else spec.lower
    if spec.type == 'integer':
        limits = IntegerRange(from_value=int(lower), to_value=int(spec.upper), step=1)
        result.integer_range = [limits]
    elif spec.type == 'double':
        limits = FloatingPointRange(from_value=float(lower), to_value=float(spec.upper))
        result.floating_point_range = [limits]
    return result


def set_callback(
    specs: Iterable[ParameterSpec], *, makes_time: bool = False
) -> Callable[[list[Parameter]], SetParametersResult]:
    """Returns the callback for `Node.add_on_set_parameters_callback` that checks new values.

    Parameters of other names pass: they belong to ROS.

    Args:
        specs: Parameters of the node.
        makes_time: Whether it makes simulated time, so that it can follow none.
    """
    from rcl_interfaces.msg import SetParametersResult

    by_name = {spec.name: spec for spec in specs}

    def check(parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name in by_name:
                    validate(by_name[parameter.name], parameter.value)
                elif makes_time and parameter.name == 'use_sim_time' and parameter.value:
                    raise ValueError('use_sim_time: this node makes simulated time, follows none')
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    return check


class StopSignals:
    """Turns SIGINT, SIGTERM and SIGHUP into a flag, so that a tick in progress is finished first.

    SIGHUP, which a closed terminal sends, only where it is not ignored, as `nohup` has it.

    rclpy's own handlers would invalidate the context in the middle of a tick, and the last messages
    with it. Only the main thread can make one.

    Attributes:
        received: Name of the signal that came, None if none did.
    """

    def __init__(self) -> None:
        self.received: str | None = None
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._handle)

    def __bool__(self) -> bool:
        """Whether to stop."""
        return self.received is not None

    def _handle(self, number: int, frame: FrameType | None) -> None:
        del frame
        self.received = signal.Signals(number).name


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
) -> int:
    """Runs a node of `NODES` as a process, or prints its help; returns the exit code of `run_node`.

    Args:
        name: Name of the executable and of the node.
        summary: What it is, in a line.
        load: Imports the class of the node, which may take long.
        args: Command line; None for that of the process.
        shared_memory: As in `run_node`.
    """
    given = sys.argv[1:] if args is None else args
    if '-h' in given or '--help' in given:
        print(usage(name, summary))
        return EXIT_SUCCESS
    return run_node(name, lambda stop: _run(load, stop), args, shared_memory)


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
    # First of all: what follows takes long enough for people to change their mind.
    stop = StopSignals()
    keep_discovery_local()
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


def _initialise(init: Callable[..., None], args: list[str] | None, handlers: Any) -> None:
    try:
        init(args=args, signal_handler_options=handlers)
    except Exception as error:
        # rclpy raises several unrelated types for malformed `--ros-args`.
        raise UsageError(' '.join(str(error).split())) from None


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
