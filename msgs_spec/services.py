"""Every service of the nodes as data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ServiceSpec:
    """One service.

    Attributes:
        name: `~/` stands for the node's own name.
        type_name: ROS name of the service type.
        node: The node that offers it.
        description: What a call does.
    """

    name: str
    type_name: str
    node: str
    description: str


RESET = ServiceSpec(
    '~/reset',
    'std_srvs/srv/Trigger',
    'sim_node',
    'Ends the running episode and starts the next one.',
)
PAUSE = ServiceSpec(
    '~/pause',
    'std_srvs/srv/SetBool',
    'sim_node',
    'Stops the ticks and simulated time (true) or goes on (false).',
)
STEP = ServiceSpec(
    '~/step',
    'std_srvs/srv/Trigger',
    'sim_node',
    'Runs one tick; only while paused.',
)
SERVICES = (RESET, PAUSE, STEP)
