"""`visualization_node`: a robot for rviz2, Foxglove and other standard tools.

`transforms.py` computes the frames, `messages.py` the messages and pictures. `node.py` is
the node, a process beside the robot.
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
