"""The services of `simulation_interfaces`, translated to what a `Robot` offers.

That package belongs to ROS and is not on PyPI, so nothing of it is imported: requests and responses
come from rclpy, and the list of features from its `SimulatorFeatures`. Constants are those of all
releases from 1.0.0 to 2.1.0; Jazzy has 1.5.1.
"""

from __future__ import annotations

from typing import Any

from fetch_hand_sim.sim_node.robot import Answer, Robot
from msgs_spec.services import MAX_STEPS

PLAYING, PAUSED = 1, 2
# What the list of features has no word for.
CUSTOM_INFO = (
    'One fixed scene; states are playing and paused; time never goes back, also over resets; '
    f'at most {MAX_STEPS} steps per call.'
)
# The default is to reset all.
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


class SimulationInterfaces:
    """One method per service, with the signature of rclpy's service callbacks.

    Args:
        robot: What is controlled.
        simulator_features: The class `simulation_interfaces.msg.SimulatorFeatures`.
    """

    def __init__(self, robot: Robot, simulator_features: Any) -> None:
        self._robot = robot
        found = (getattr(simulator_features, name, None) for name in FEATURES)
        self._features = [value for value in found if value is not None]

    def get_simulator_features(self, request: Any, response: Any) -> Any:
        """Lists what is supported."""
        del request
        response.features.features = self._features
        response.features.custom_info = CUSTOM_INFO
        return response

    def get_simulation_state(self, request: Any, response: Any) -> Any:
        """Playing or paused; a robot in lockstep that waits for a command plays."""
        del request
        response.state.state = PAUSED if self._robot.schedule.is_paused else PLAYING
        return _finish(response, OK, '')

    def set_simulation_state(self, request: Any, response: Any) -> Any:
        """Pauses or goes on."""
        target = request.state.state
        if target not in (PLAYING, PAUSED):
            line = f'state {target} asked for; allowed: {PLAYING} (playing), {PAUSED} (paused)'
            return _finish(response, FEATURE_UNSUPPORTED, line)
        is_there = self._robot.schedule.is_paused == (target == PAUSED)
        answer = self._robot.pause(target == PAUSED)
        return _finish(response, ALREADY_IN_TARGET_STATE if is_there else OK, answer.message)

    def reset_simulation(self, request: Any, response: Any) -> Any:
        """Ends the episode (state) or begins the series again (all); time is never set back."""
        if request.scope not in (SCOPE_DEFAULT, SCOPE_STATE, SCOPE_ALL):
            line = f'scope {request.scope} asked for; allowed: {SCOPE_STATE} (state), '
            line += f'{SCOPE_DEFAULT} and {SCOPE_ALL} (all but time, which never goes back)'
            return _finish(response, FEATURE_UNSUPPORTED, line)
        if request.scope == SCOPE_STATE:
            return _answer(response, self._robot.reset())
        answer = self._robot.reset(to_first_episode=True)
        # All but what the scope has by its definition.
        return _answer(response, Answer(answer.success, f'{answer.message}; time goes on'))

    def step_simulation(self, request: Any, response: Any) -> Any:
        """Runs the given number of ticks, which are control periods, while paused."""
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
