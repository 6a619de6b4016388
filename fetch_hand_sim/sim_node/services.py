"""Offers the services of a robot on a node."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fetch_hand_sim.sim_node.robot import Answer, Robot
from fetch_hand_sim.sim_node.simulation_interfaces import SimulationInterfaces
from msgs_spec.services import INTERFACE_SERVICES, PAUSE, RESET, STEP
from node_runtime.ros import ros_service_class

if TYPE_CHECKING:
    from rclpy.node import Node


def open_services(node: Node, robot: Robot) -> None:
    """Opens the services of `std_srvs`, and of `simulation_interfaces` where it is installed."""
    answers: dict[Any, Callable[[Any], Answer]] = {
        RESET: lambda request: robot.reset(),
        PAUSE: lambda request: robot.pause(request.data),
        STEP: lambda request: robot.step(),
    }
    for spec, answer in answers.items():
        node.create_service(ros_service_class(spec.type_name), spec.name, _callback(answer))
    try:
        messages = import_module('simulation_interfaces.msg')
    except ImportError:
        return
    interfaces = SimulationInterfaces(robot, messages.SimulatorFeatures)
    for spec in INTERFACE_SERVICES:
        callback = getattr(interfaces, spec.name.removeprefix('~/'))
        node.create_service(ros_service_class(spec.type_name), spec.name, callback)


def _callback(answer: Callable[[Any], Answer]) -> Callable[[Any, Any], Any]:
    def on_request(request: Any, response: Any) -> Any:
        result = answer(request)
        response.success, response.message = result.success, result.message
        return response

    return on_request
