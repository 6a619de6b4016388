"""Services of the nodes as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServiceSpec:
    """One service.

    Attributes:
        name: `~/` stands for the node's own name.
        type_name: ROS name of the service type.
        description: Effect of a call.
    """

    name: str
    type_name: str
    description: str
    node: str = 'sim_node'


# A call blocks the robot while it steps; the slowest task needs a few seconds for this many ticks.
MAX_STEPS = 1000

RESET = ServiceSpec(
    '~/reset', 'std_srvs/srv/Trigger', 'Ends the running episode; the next tick starts another.'
)
PAUSE = ServiceSpec(
    '~/pause',
    'std_srvs/srv/SetBool',
    'Stops the ticks and simulated time (true) or continues (false).',
)
STEP = ServiceSpec(
    '~/step', 'std_srvs/srv/Trigger', 'Runs one tick now; while paused, or in lockstep.'
)
STANDARD_SERVICES = (RESET, PAUSE, STEP)


def _interface(name: str, type_name: str, description: str) -> ServiceSpec:
    return ServiceSpec(name, f'simulation_interfaces/srv/{type_name}', description)


# Only where the package simulation_interfaces is installed, which is not on PyPI.
GET_FEATURES = _interface(
    '~/get_simulator_features', 'GetSimulatorFeatures', 'Lists the features below.'
)
GET_STATE = _interface('~/get_simulation_state', 'GetSimulationState', 'Playing or paused.')
SET_STATE = _interface('~/set_simulation_state', 'SetSimulationState', 'As `~/pause`.')
RESET_SIMULATION = _interface(
    '~/reset_simulation',
    'ResetSimulation',
    'As `~/reset` (scope state), or begins the series again, with the `seed` as it is set then; '
    'time is never set back.',
)
STEP_SIMULATION = _interface(
    '~/step_simulation',
    'StepSimulation',
    f'Runs the given number of ticks, 1 ... {MAX_STEPS}; while paused.',
)
INTERFACE_SERVICES = (GET_FEATURES, GET_STATE, SET_STATE, RESET_SIMULATION, STEP_SIMULATION)
SERVICES = (*STANDARD_SERVICES, *INTERFACE_SERVICES)
