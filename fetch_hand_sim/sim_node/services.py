"""The services of a simulator node, with types of `std_srvs` and `simulation_interfaces`.

The package `simulation_interfaces` is part of ROS but not on PyPI. So its constants are repeated
here. They are the same in releases 1.0.0 to 2.1.0; Jazzy has 1.5.1.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any

from fetch_hand_sim.sim_node.robot import Answer, Robot
from msgs_spec.topics import INTERFACE_SERVICES, MAX_STEPS, PAUSE, RESET, STEP
from node_runtime.ros import ros_service_class

if TYPE_CHECKING:
    from rclpy.node import Node

PLAYING, PAUSED = 1, 2
CUSTOM_INFO = (
    'One fixed scene; states are playing and paused; time never goes back, also over resets; '
    f'at most {MAX_STEPS} steps per call.'
)
# The default scope resets all.
SCOPE_DEFAULT, SCOPE_STATE, SCOPE_ALL = 0, 2, 255
FEATURE_UNSUPPORTED, OK, OPERATION_FAILED = 0, 1, 4
ALREADY_IN_TARGET_STATE = 101
FEATURES = (
    'SIMULATION_RESET',
    'SIMULATION_RESET_STATE',
    'SIMULATION_STATE_GETTING',
    'SIMULATION_STATE_SETTING',
    'SIMULATION_STATE_PAUSE',
    'STEP_SIMULATION_SINGLE',
    'STEP_SIMULATION_MULTIPLE',
)


def open_services(node: Node, robot: Robot) -> None:
    """Create the services of `std_srvs`, and of `simulation_interfaces` if it is installed."""
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


class SimulationInterfaces:
    """Callbacks of the `simulation_interfaces` services; each method is named like its service."""

    def __init__(self, robot: Robot, simulator_features: Any) -> None:
        self._robot = robot
        found = (getattr(simulator_features, name, None) for name in FEATURES)
        self._features = [value for value in found if value is not None]

    def get_simulator_features(self, request: Any, response: Any) -> Any:
        """List the supported features."""
        del request
        response.features.features = self._features
        response.features.custom_info = CUSTOM_INFO
        return response

    def get_simulation_state(self, request: Any, response: Any) -> Any:
        """Report the state playing or paused; waiting for a command counts as playing."""
        del request
        response.state.state = PAUSED if self._robot.schedule.is_paused else PLAYING
        return _finish(response, OK, '')

    def set_simulation_state(self, request: Any, response: Any) -> Any:
        """Pause or resume the simulation; reject states other than playing and paused."""
        target = request.state.state
        if target not in (PLAYING, PAUSED):
            line = f'state {target} given; allowed: {PLAYING} (playing), {PAUSED} (paused)'
            return _finish(response, FEATURE_UNSUPPORTED, line)
        is_there = self._robot.schedule.is_paused == (target == PAUSED)
        answer = self._robot.pause(target == PAUSED)
        return _finish(response, ALREADY_IN_TARGET_STATE if is_there else OK, answer.message)

    def reset_simulation(self, request: Any, response: Any) -> Any:
        """End the episode; start the next one (scope `state`) or the first (`all` or default)."""
        if request.scope not in (SCOPE_DEFAULT, SCOPE_STATE, SCOPE_ALL):
            line = f'scope {request.scope} given; allowed: {SCOPE_STATE} (state), '
            line += f'{SCOPE_DEFAULT} and {SCOPE_ALL} (all but time, which never goes back)'
            return _finish(response, FEATURE_UNSUPPORTED, line)
        if request.scope == SCOPE_STATE:
            return _answer(response, self._robot.reset())
        answer = self._robot.reset(to_first_episode=True)
        # By its definition, the scope includes time.
        return _answer(response, Answer(answer.success, f'{answer.message}; time goes on'))

    def step_simulation(self, request: Any, response: Any) -> Any:
        """Run the requested ticks, then answer; report failure unless the simulation is paused."""
        if not self._robot.schedule.is_paused:
            line = 'a simulation is stepped only while it is paused'
            return _finish(response, OPERATION_FAILED, line)
        return _answer(response, self._robot.step(int(request.steps)))


def _answer(response: Any, answer: Answer) -> Any:
    return _finish(response, OK if answer.success else OPERATION_FAILED, answer.message)


def _finish(response: Any, result: int, message: str) -> Any:
    response.result.result = result
    response.result.error_message = message
    return response
