"""Declare the parameters of `msgs_spec.parameters` on a node and check changes."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

from msgs_spec.parameters import ParameterSpec, unknown_parameter, validate

if TYPE_CHECKING:
    from rcl_interfaces.msg import ParameterDescriptor, SetParametersResult
    from rclpy.node import Node
    from rclpy.parameter import Parameter


def declare_parameters(node: Node, specs: Sequence[ParameterSpec]) -> dict[str, Any]:
    """Declare parameters with description and range, and return their values by name.

    This function also offers the parameter services, so create the node with
    `start_parameter_services=False`. It warns of unknown parameters and of former names, whose
    values it uses. It raises ValueError if a given value is not allowed.
    """
    _serve_parameter_requests(node)
    # rclpy has no public access to given values before their declaration.
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
        # rclpy's own errors do not name the allowed values.
        validate(spec, given.value)
    value = node.declare_parameter(spec.name, spec.default, descriptor(spec)).value
    if spec.is_path:
        return os.path.expanduser(value)
    return float(value) if spec.type == 'double' else value


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the ROS descriptor of a parameter.

    Doubles are typed dynamically, because ROS reads `1` as an integer and would reject it.
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
    """Return a callback for `Node.add_on_set_parameters_callback` that checks new values.

    Parameters that are not in `specs`, such as those of ROS, are accepted. Set `makes_time` for
    the node that publishes simulated time; it then rejects `use_sim_time: true`.
    """
    from rcl_interfaces.msg import SetParametersResult

    by_name = {spec.name: spec for spec in specs}

    def check(parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name in by_name:
                    validate(by_name[parameter.name], parameter.value)
                elif makes_time and parameter.name == 'use_sim_time' and parameter.value:
                    raise ValueError('use_sim_time: true given; allowed: false in this node')
        except ValueError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    return check


def _serve_parameter_requests(node: Node) -> None:
    """Offer the parameter services, which reject values whose type number ROS does not define.

    The services of rclpy would raise an exception for such values, which ends the node.
    """
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter_service import ParameterService

    class ParameterRequests(ParameterService):
        def _set_parameters_callback(self, request: Any, response: Any) -> Any:
            answer = super()._set_parameters_callback
            for parameter in request.parameters:
                rejected = _rejection(parameter)
                if rejected is None:
                    one = SetParameters.Request(parameters=[parameter])
                    answer(one, response)  # type: ignore[no-untyped-call]
                else:
                    response.results.append(rejected)
            return response

        def _set_parameters_atomically_callback(self, request: Any, response: Any) -> Any:
            for rejected in filter(None, map(_rejection, request.parameters)):
                response.result = rejected
                return response
            answer = super()._set_parameters_atomically_callback
            return answer(request, response)  # type: ignore[no-untyped-call]

    # Its services keep it alive.
    ParameterRequests(node)  # type: ignore[no-untyped-call]


def _rejection(message: Any) -> SetParametersResult | None:
    """Return the rejection of a `Parameter` message with an undefined type number, else None."""
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.parameter import Parameter

    try:
        Parameter.from_parameter_msg(message)
    except ValueError:
        types = ', '.join(f'{kind.value} ({kind.name})' for kind in Parameter.Type)
        reason = f'{message.name}: type {message.value.type} given; allowed: {types}'
        return SetParametersResult(successful=False, reason=reason)
    return None
