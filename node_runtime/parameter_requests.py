"""Answers requests for parameters as rclpy does, and refuses types that there are not.

rclpy raises out of the executor for a number that is no `ParameterType`, which ends the node: one
request of anybody would.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.node import Node


def serve_parameter_requests(node: Node) -> None:
    """Offers the parameter services of a node made with `start_parameter_services=False`."""
    from rcl_interfaces.srv import SetParameters
    from rclpy.parameter_service import ParameterService

    class ParameterRequests(ParameterService):
        def _set_parameters_callback(self, request: Any, response: Any) -> Any:
            answer = super()._set_parameters_callback
            for parameter in request.parameters:
                refused = _refusal(parameter)
                if refused is None:
                    one = SetParameters.Request(parameters=[parameter])
                    answer(one, response)  # type: ignore[no-untyped-call]
                else:
                    response.results.append(refused)
            return response

        def _set_parameters_atomically_callback(self, request: Any, response: Any) -> Any:
            for refused in filter(None, map(_refusal, request.parameters)):
                response.result = refused
                return response
            answer = super()._set_parameters_atomically_callback
            return answer(request, response)  # type: ignore[no-untyped-call]

    # Its services keep it alive.
    ParameterRequests(node)  # type: ignore[no-untyped-call]


def _refusal(message: Any) -> SetParametersResult | None:
    """Why no parameter can be made of a message; None if one can."""
    from rcl_interfaces.msg import SetParametersResult
    from rclpy.parameter import Parameter

    try:
        Parameter.from_parameter_msg(message)
    except ValueError:
        types = ', '.join(f'{kind.value} ({kind.name})' for kind in Parameter.Type)
        reason = f'{message.name}: type {message.value.type} given; allowed: {types}'
        return SetParametersResult(successful=False, reason=reason)
    return None
