"""`policy_node`: join the topics of a robot by stamp, run a policy, publish its commands.

It uses topics only, so it also works on another machine or with a replayed episode. `responder.py`
handles messages without ROS; `node.py` is the node. Slow imports run only after the handler of
Ctrl-C is set.
"""

from __future__ import annotations

from node_runtime.node_main import node_main

NODE_NAME = 'policy_node'
SUMMARY = 'Command a robot with a policy, from its topics.'


def main(args: list[str] | None = None) -> int:
    """Run `policy_node` and return the exit code."""
    # The user's own code may hang.
    return node_main(
        NODE_NAME, SUMMARY, 'policy_node.node.node:PolicyNode', args, second_signal_ends=True
    )
