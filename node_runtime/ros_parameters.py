"""Parameters as data (`parameters.py`), declared on a node and changed while it runs."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from msgs_spec.parameters import ParameterSpec, unknown_parameter, validate
from node_runtime.command_line import UsageError
from node_runtime.parameter_requests import serve_parameter_requests

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.node import Node
    from rclpy.parameter import Parameter


def declare_parameters(node: Node, specs: Sequence[ParameterSpec]) -> dict[str, Any]:
    """Declares parameters with description and range and returns their values.

    Requests for them are answered from then on: the node is made without rclpy's services for them.

    Parameters that it was given and does not have, or that have a new name, are named in a warning.

    Raises:
        UsageError: If a value given at the start is not allowed.
    """
    serve_parameter_requests(node)
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
