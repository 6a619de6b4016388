"""`replay_node`: publishes the messages of a logged episode with the recorded timing.

It publishes the topics of `sim_node`, so `policy_node` works with a replay, too. Recorded commands
are published only on request, because they would mix with those of a policy. `schedule.py` computes
what to publish when, without ROS; `node.py` is the node.
"""

from __future__ import annotations

from node_runtime.node_main import node_main

NODE_NAME = 'replay_node'
SUMMARY = 'A recorded episode, published once more.'


def main(args: list[str] | None = None) -> int:
    """Run `replay_node` and return the exit code."""
    return node_main(NODE_NAME, SUMMARY, 'fetch_hand_sim.replay_node.node:ReplayNode', args)
