"""`view`: show a running robot, or episode files, on a page in the browser.

`live.py` follows a robot over ROS, `player.py` plays files. `page/` draws both in MuJoCo's web
viewer. `web.py` serves this viewer, and `guard.py` checks all requests.
"""

from __future__ import annotations


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    from fetch_hand_sim.view.command import run

    return run(arguments)
