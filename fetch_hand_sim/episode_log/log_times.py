"""Log times: simulated time, one nanosecond between the messages of a tick.

All messages of a tick carry the same stamp; a file needs an order. Message number r after the stamp
s, counted from 0, is logged at s + r nanoseconds. The messages of the tick come first, in the order
they are published; commands received after them and before the next tick follow, in the order they
arrive. So a command lies between the state it was computed from and the state it leads to, and
times grow strictly.
"""

from __future__ import annotations


def log_time(stamp_ns: int, rank: int) -> int:
    """Returns the log time in nanoseconds of message number `rank` of the tick stamped `stamp_ns`.

    Raises:
        ValueError: If one of them is negative; MCAP times are unsigned.
    """
    if stamp_ns < 0 or rank < 0:
        raise ValueError(f'stamp {stamp_ns} ns and rank {rank} must not be negative')
    return stamp_ns + rank
