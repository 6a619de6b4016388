"""`visualization_node`: publishes what rviz2, Foxglove and other tools need to show a robot.

`transforms.py` computes frames, `messages.py` messages and pictures. `node.py` is the node, which
runs in a process of its own.
"""

from __future__ import annotations

from node_runtime.node_main import node_main

NODE_NAME = 'visualization_node'
SUMMARY = 'URDF, transforms, markers and a camera of a running robot, for standard tools.'


def main(args: list[str] | None = None) -> int:
    """Run `visualization_node` and return the exit code."""
    return node_main(
        NODE_NAME,
        SUMMARY,
        'fetch_hand_sim.visualization_node.node:VisualizationNode',
        args,
        shared_memory=True,
    )
