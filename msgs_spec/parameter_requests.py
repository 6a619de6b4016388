"""Answers requests for parameters as rclpy does, and refuses types that there are not.

rclpy raises out of the executor for a number that is no `ParameterType`, which ends the node: one
request of anybody would.
"""

from __future__ import annotations

from typing import Any

from rcl_interfaces.msg import SetParametersResult
from rcl_interfaces.srv import SetParameters
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_service import ParameterService


class ParameterRequests(ParameterService):
    """The parameter services of a node that is made with `start_parameter_services=False`."""

    def _set_parameters_callback(self, request: Any, response: Any) -> Any:
        for parameter in request.parameters:
            refused = _refusal(parameter)
            if refused is None:
                one = SetParameters.Request(parameters=[parameter])
                super()._set_parameters_callback(one, response)  # type: ignore[no-untyped-call]
            else:
                response.results.append(refused)
        return response

    def _set_parameters_atomically_callback(self, request: Any, response: Any) -> Any:
        for refused in filter(None, map(_refusal, request.parameters)):
            response.result = refused
            return response
        answer = super()._set_parameters_atomically_callback
        return answer(request, response)  # type: ignore[no-untyped-call]


class CheckedNode(Node):
    """A node that no request for a parameter ends."""

    def __init__(self, name: str) -> None:
        super().__init__(name, start_parameter_services=False)
        self._parameter_requests = ParameterRequests(self)  # type: ignore[no-untyped-call]


def _refusal(message: Any) -> SetParametersResult | None:
    """Why no parameter can be made of a message; None if one can."""
    try:
        Parameter.from_parameter_msg(message)
    except ValueError:
        types = ', '.join(f'{kind.value} ({kind.name})' for kind in Parameter.Type)
        reason = f'{message.name}: type {message.value.type} given; allowed: {types}'
        return SetParametersResult(successful=False, reason=reason)
    return None
