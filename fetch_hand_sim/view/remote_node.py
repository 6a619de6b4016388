"""Calls services and sets parameters of another node without waiting for it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from rclpy.node import Node

from node_runtime.ros import ros_service_class

_SET_PARAMETERS = 'rcl_interfaces/srv/SetParameters'
_GET_PARAMETERS = 'rcl_interfaces/srv/GetParameters'
# Seconds for an answer.
_PATIENCE = 3.0


class RemoteNode:
    """Another node, by name.

    Args:
        node: Of this process.
        name: Of the other one, in the namespace of ours or fully qualified.
        notice: Gets a line about what a call led to.
    """

    def __init__(self, node: Node, name: str, notice: Callable[[str], None]) -> None:
        self._node = node
        self._name = name
        self._notice = notice
        self._clients: dict[str, Any] = {}
        self._asked: dict[str, tuple[Any, float]] = {}

    def is_there(self) -> bool:
        """Whether it answers services."""
        return bool(self._client('set_parameters', _SET_PARAMETERS).service_is_ready())

    def call(
        self,
        service: str,
        type_name: str,
        then: Callable[[], None] | None = None,
        **fields: Any,
    ) -> None:
        """Calls a service of the kind that says whether it worked, and goes on where it did.

        Args:
            service: Its name, below the node's or fully qualified.
            type_name: Its type.
            then: Called after an answer that says so.
            fields: Of the request.
        """

        def answered(response: Any) -> None:
            self._notice(response.message)
            if response.success and then is not None:
                then()

        self._call(service, type_name, fields, answered)

    def get_parameter(self, name: str, then: Callable[[Any], None]) -> None:
        """Hands a parameter on when it comes; does nothing where the node has none, or is none."""
        from rclpy.parameter import parameter_value_to_python

        def answered(future: Any) -> None:
            values = [parameter_value_to_python(each) for each in future.result().values]
            for value in values:
                if value is not None:
                    then(value)

        client = self._client('get_parameters', _GET_PARAMETERS)
        if client.service_is_ready() and not self._awaits(name):
            request = ros_service_class(_GET_PARAMETERS).Request(names=[name])
            future = client.call_async(request)
            self._asked[name] = future, time.monotonic()
            future.add_done_callback(answered)

    def _awaits(self, name: str) -> bool:
        """Whether an answer is on its way.

        A node that hangs would find all questions when it goes on; one that is gone answers none,
        and another in its place has not heard them.
        """
        future, asked = self._asked.get(name, (None, 0.0))
        return future is not None and not future.done() and time.monotonic() - asked < _PATIENCE

    def set_parameter(
        self, name: str, value: str | int | float, then: Callable[[], None] | None = None
    ) -> None:
        """Sets a parameter and goes on where it was accepted."""
        from rclpy.parameter import Parameter

        def answered(response: Any) -> None:
            result = response.results[0]
            if not result.successful:
                self._notice(f'{self._name} refuses {name}: {result.reason}')
            elif then is not None:
                then()
            else:
                self._notice(f'{name}: {value}')

        parameter = Parameter(name, value=value).to_parameter_msg()
        self._call('set_parameters', _SET_PARAMETERS, {'parameters': [parameter]}, answered)

    def close(self) -> None:
        """Forgets the other node; answers on their way are not heard."""
        for client in self._clients.values():
            self._node.destroy_client(client)
        self._clients.clear()
        self._asked.clear()

    def _call(
        self,
        service: str,
        type_name: str,
        fields: dict[str, Any],
        answered: Callable[[Any], None],
    ) -> None:
        client = self._client(service, type_name)
        if not client.service_is_ready():
            self._notice(f'{self._name} does not answer')
            return
        request = ros_service_class(type_name).Request(**fields)
        client.call_async(request).add_done_callback(lambda future: answered(future.result()))

    def _client(self, service: str, type_name: str) -> Any:
        if service not in self._clients:
            name = service if service.startswith('/') else f'{self._name}/{service}'
            self._clients[service] = self._node.create_client(ros_service_class(type_name), name)
        return self._clients[service]
