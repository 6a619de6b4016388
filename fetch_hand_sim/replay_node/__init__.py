"""`replay_node`: publishes a logged episode on its topics with its timing.

Whatever listens to a robot can listen to the replay, `policy_node` too. What the robot had received
is not published, unless asked for: the commands of the log would mix with those of a policy.
`schedule.py` says what to publish when, without ROS; `node.py` is the node.
"""

from __future__ import annotations

from collections.abc import Callable

from node_runtime.node_main import RunnableNode, node_main

NODE_NAME = 'replay_node'
SUMMARY = 'A recorded episode, published once more.'


def main(args: list[str] | None = None) -> int:
    """Runs `replay_node`; returns the exit code."""

    def load() -> Callable[[], RunnableNode]:
        from fetch_hand_sim.replay_node.node import ReplayNode

        return ReplayNode

    return node_main(NODE_NAME, SUMMARY, load, args)
