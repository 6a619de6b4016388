"""How far a command leads the Fetch gripper, so that it is as fast at every rate as at 25 Hz.

A command does not move the gripper: it puts the mocap body that much ahead of it, and a weld pulls.
Its `solref` of (0.02, 1) makes that a critically damped spring with w = 1 / 0.02 s, so the gripper
covers most of the lead in 40 ms and has nearly stopped when the next command leads it anew. Led
anew every 4 ms it is pulled all the time. The same lead is thus 1.45 times as fast at 250 Hz as at
25 Hz, and a tenth of it, for a tenth of the time, seven times slower.
"""

from __future__ import annotations

import math

from msgs_spec.tasks import DEFAULT_CONTROL_HZ

# Time constant of the weld between mocap body and gripper (`fetch/shared.xml`), seconds.
_TIME_CONSTANT = 0.02


def lead_scale(control_hz: float) -> float:
    """What leads are multiplied by at an action frequency in Hz; exactly 1 at 25 Hz."""
    return _steady_speed(DEFAULT_CONTROL_HZ) / _steady_speed(control_hz)


def _steady_speed(control_hz: float) -> float:
    """Mean speed per metre of lead, 1/s, where every command leads as much as the one before.

    With x = w T, a spring let go at a distance of 1 with a speed of w u is at
    (1 - (u - 1) x) exp(-x) after T; u is the speed at which it begins as fast as it ends.
    """
    x = 1.0 / (control_hz * _TIME_CONSTANT)
    decay = math.exp(-x)
    u = x * decay / (1.0 - (1.0 - x) * decay)
    return (1.0 - (1.0 - (u - 1.0) * x) * decay) * control_hz
