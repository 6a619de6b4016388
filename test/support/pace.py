"""Check that a robot keeps its rate beside a load, even on a busy machine."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from msgs_spec.codecs import message_stamp
from support.graph import Client

TOPIC = 'achieved_goal'
CONTROL_HZ = 25.0
# Allowed loss of ticks per second.
_LOSS = 0.4
# Seconds before a turn and of a turn; after so many pairs of turns the robot is found too slow.
_SETTLING, _TURN = 0.5, 3.0
_PAIRS = 6


def assert_keeps_pace(
    connection: Client, beside: Callable[[], AbstractContextManager[object]]
) -> None:
    """Compare the simulated time that passes with and without a load.

    Other processes slow both kinds of turns, so on a busy machine more pairs of turns follow until
    both are equally fast. A missed tick is lost, so simulated time counts all of them.

    Args:
        connection: A client that subscribed to `TOPIC`.
        beside: Context in which the load runs.
    """
    alone, disturbed = np.zeros(2), np.zeros(2)
    for _ in range(_PAIRS):
        alone += progress(connection)
        with beside():
            disturbed += progress(connection)
        before, now = (CONTROL_HZ * simulated / real for simulated, real in (alone, disturbed))
        # A busy machine may deliver ticks in bursts, above 25 Hz.
        if now > min(before, CONTROL_HZ) - _LOSS:
            return
    raise AssertionError(f'{now:.2f} Hz, {before:.2f} Hz without load')


def progress(connection: Client) -> np.ndarray:
    """Return simulated and real seconds between the arrivals of two ticks."""
    # Ticks that arrived before the subscriber spins would have a wrong arrival time.
    connection.spin(_SETTLING)
    began = _next_tick(connection)
    connection.spin(_TURN)
    return _next_tick(connection) - began


def _next_tick(connection: Client) -> np.ndarray:
    """Return stamp and arrival of the next tick, in seconds."""
    ticks = connection.received[TOPIC]
    count = len(ticks)
    connection.spin_until(lambda: len(ticks) > count, 'tick')
    return np.array([1e-9 * message_stamp(ticks[-1]), connection.received_at[TOPIC][-1]])
