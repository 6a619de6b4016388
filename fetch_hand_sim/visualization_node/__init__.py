"""`visualization_node`: a robot for rviz2, Foxglove and other standard tools.

`transforms.py` says where every frame is, `messages.py` makes messages of it, `camera.py` draws
pictures; `node.py` is the node, a subscriber of its own beside the robot.
"""

from __future__ import annotations

from collections.abc import Callable

from node_runtime.node_main import RunnableNode, node_main

NODE_NAME = 'visualization_node'
SUMMARY = 'URDF, transforms, markers and a camera of a running robot, for standard tools.'


def main(args: list[str] | None = None) -> int:
    """Runs `visualization_node`; returns the exit code."""

    def load() -> Callable[[], RunnableNode]:
        from fetch_hand_sim.visualization_node.node import VisualizationNode

        return VisualizationNode

    return node_main(NODE_NAME, SUMMARY, load, args, shared_memory=True)
