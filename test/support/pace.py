"""Whether a robot in real time keeps its pace beside something, also on a machine that is busy."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

from msgs_spec.codecs import message_stamp
from support.graph import Client

TOPIC = 'achieved_goal'
CONTROL_HZ = 25.0
# Ticks per second that nobody may cost a robot.
_LOSS = 0.4
# Seconds before a turn and of a turn; after so many pairs of turns the robot is found too slow.
_SETTLING, _TURN = 0.5, 3.0
_PAIRS = 6


def assert_keeps_pace(
    connection: Client, beside: Callable[[], AbstractContextManager[object]]
) -> None:
    """Compares turns of a robot that is left alone with turns beside something.

    What counts is how far the simulated time gets: a tick that is missed is never made up for. On
    a quiet machine one pair of turns tells 24 Hz from 25. On a busy one both kinds of turns are as
    slow as others leave them, so more pairs are taken until they are as fast as each other.

    Args:
        connection: Has subscribed to `TOPIC`.
        beside: Begins what the robot shall not notice, and ends it.
    """
    alone, disturbed = np.zeros(2), np.zeros(2)
    for _ in range(_PAIRS):
        alone += progress(connection)
        with beside():
            disturbed += progress(connection)
        before, now = (CONTROL_HZ * simulated / real for simulated, real in (alone, disturbed))
        # Faster than it should be is only how a busy machine delivers.
        if now > min(before, CONTROL_HZ) - _LOSS:
            return
    raise AssertionError(f'{now:.2f} Hz, {before:.2f} Hz when left alone')


def progress(connection: Client) -> np.ndarray:
    """Simulated and real seconds of a turn, from the arrival of one tick to that of another."""
    # Ticks that came while nobody listened would count with the time at which they are read.
    connection.spin(_SETTLING)
    began = _next_tick(connection)
    connection.spin(_TURN)
    return _next_tick(connection) - began


def _next_tick(connection: Client) -> np.ndarray:
    """Stamp and arrival of the next tick, s; a robot that stands still has none."""
    ticks = connection.received[TOPIC]
    count = len(ticks)
    connection.spin_until(lambda: len(ticks) > count, 'tick')
    return np.array([1e-9 * message_stamp(ticks[-1]), connection.received_at[TOPIC][-1]])
