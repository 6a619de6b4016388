"""`replay_node`: publishes a logged episode on its topics with its timing.

Every subscriber of a robot can subscribe to the replay, including `policy_node`. Recorded commands
are published on request only, because they would mix with those of a policy. `schedule.py` contains
the messages and their times, without ROS; `node.py` is the node.
"""

from __future__ import annotations

from node_runtime.node_main import node_main

NODE_NAME = 'replay_node'
SUMMARY = 'A recorded episode, published once more.'


def main(args: list[str] | None = None) -> int:
    """Run `replay_node` and return the exit code."""
    return node_main(NODE_NAME, SUMMARY, 'fetch_hand_sim.replay_node.node:ReplayNode', args)
