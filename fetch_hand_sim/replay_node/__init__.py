"""`replay_node`: publishes a logged episode on its topics with its timing.

Whatever listens to a robot can listen to the replay, `policy_node` too. What the robot had received
is not published, unless asked for: the commands of the log would mix with those of a policy.
`schedule.py` says what to publish when, without ROS; `node.py` is the node.
"""

from __future__ import annotations

from msgs_spec.ros import StopSignals, run_node

NODE_NAME = 'replay_node'


def main(args: list[str] | None = None) -> int:
    """Runs `replay_node`; returns the exit code."""

    def run(stop: StopSignals) -> None:
        from fetch_hand_sim.replay_node.node import ReplayNode

        if stop:
            return
        node = ReplayNode()
        try:
            node.run(stop)
        finally:
            node.destroy_node()

    return run_node(NODE_NAME, run, args)
