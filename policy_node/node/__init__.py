"""`policy_node`: joins the topics of a robot by stamp, runs an actor, publishes its commands.

It knows the robot by topics alone, so it runs as well on another machine or against a replayed
episode. `responder.py` holds what it does with a message, without ROS; `node.py` is the node.
Nothing is imported here that takes long, so that Ctrl-C finds its handler in place.
"""

from __future__ import annotations

from msgs_spec.ros import StopSignals, run_node

NODE_NAME = 'policy_node'


def main(args: list[str] | None = None) -> int:
    """Runs `policy_node`; returns the exit code."""

    def run(stop: StopSignals) -> None:
        from policy_node.node.node import PolicyNode

        if stop:
            return
        node = PolicyNode()
        try:
            node.run(stop)
        finally:
            node.destroy_node()

    return run_node(NODE_NAME, run, args)
