"""`sim_node`: a ROS node that simulates one robot.

`robot.py` is the robot without ROS, `node.py` its node. `main` imports slow modules after it has
set the signal handlers.
"""

from __future__ import annotations

from node_runtime.node_main import node_main

NODE_NAME = 'sim_node'
SUMMARY = 'One simulated robot on the network.'


def main(args: list[str] | None = None) -> int:
    """Run `sim_node` and return the exit code."""
    return node_main(NODE_NAME, SUMMARY, 'fetch_hand_sim.sim_node.node:SimNode', args)
