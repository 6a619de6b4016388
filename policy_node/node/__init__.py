"""`policy_node`: joins the topics of a robot by stamp, runs an actor, publishes its commands.

It uses topics only, so it also works on another machine or with a replayed
episode. `responder.py` holds what it does with a message, without ROS; `node.py` is the node.
Nothing is imported here that takes long, so that Ctrl-C finds its handler in place.
"""

from __future__ import annotations

from collections.abc import Callable

from node_runtime.node_main import RunnableNode, node_main

NODE_NAME = 'policy_node'
SUMMARY = 'Commands for a robot, from an actor that sees its topics.'


def main(args: list[str] | None = None) -> int:
    """Runs `policy_node`; returns the exit code."""

    def load() -> Callable[[], RunnableNode]:
        from policy_node.node.node import PolicyNode

        return PolicyNode

    # A policy may be code of the user's own, which may hang.
    return node_main(NODE_NAME, SUMMARY, load, args, second_signal_ends=True)
