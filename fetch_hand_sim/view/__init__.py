"""`view`: show a running robot, or episode files, on a page in the browser.

`live.py` follows a robot over ROS, `player.py` plays files. `page/` draws them in MuJoCo's web
viewer, which `web.py` serves behind `guard.py`.
"""

from __future__ import annotations


def main(arguments: list[str] | None = None) -> int:
    """Run the command; return its exit code."""
    from fetch_hand_sim.view.command import run

    return run(arguments)
