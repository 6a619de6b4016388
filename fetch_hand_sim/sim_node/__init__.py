"""`sim_node`: one simulated robot on the network.

`robot.py` holds what a robot does and how it answers, without ROS; `node.py` is the node around
it. Nothing is imported here that takes long, so that Ctrl-C finds its handler in place.
"""

from __future__ import annotations

from collections.abc import Callable

from node_runtime.node_main import RunnableNode, node_main

NODE_NAME = 'sim_node'
SUMMARY = 'One simulated robot on the network.'


def main(args: list[str] | None = None) -> int:
    """Runs `sim_node`; returns the exit code."""

    def load() -> Callable[[], RunnableNode]:
        from fetch_hand_sim.sim_node.node import SimNode

        return SimNode

    return node_main(NODE_NAME, SUMMARY, load, args)
