"""`sim_node`: one simulated robot on the network.

`robot.py` holds what a robot does and how it answers, without ROS; `node.py` is the node around
it. Nothing is imported here that takes long, so that Ctrl-C finds its handler in place.
"""

from __future__ import annotations

from msgs_spec.ros import StopSignals, run_node

NODE_NAME = 'sim_node'


def main(args: list[str] | None = None) -> int:
    """Runs `sim_node`; returns the exit code."""

    def run(stop: StopSignals) -> None:
        from fetch_hand_sim.sim_node.node import SimNode

        if stop:
            return
        node = SimNode()
        try:
            node.run(stop)
        finally:
            node.destroy_node()

    return run_node(NODE_NAME, run, args)
