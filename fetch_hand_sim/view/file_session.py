"""Plays episode files on the page; no ROS is needed."""

from __future__ import annotations

import argparse
import time

from fetch_hand_sim.episode_log import EpisodeReadError
from fetch_hand_sim.films.recording import find_playable
from fetch_hand_sim.view.frame_rate import FrameRate
from fetch_hand_sim.view.page.page import Page
from fetch_hand_sim.view.player import Player
from fetch_hand_sim.view.session import Requests, Session
from fetch_hand_sim.view.web import announce, open_page
from node_runtime.command_line import EXIT_SUCCESS, UsageError
from node_runtime.node_main import StopSignals

_FRAME_TIME = 1.0 / 60.0


def run_files(options: argparse.Namespace) -> int:
    """Runs until the user ends it; returns the exit code.

    Raises:
        UsageError: If there is nothing to play.
        CannotServe: If the page cannot be served.
    """
    stop = StopSignals()
    try:
        paths = find_playable(options.path)
        player = Player(paths, may_act=not options.read_only)
    except EpisodeReadError as error:
        raise UsageError(str(error)) from None
    handle, address = open_page(
        options.host, options.port, [Page(tuple(paths)), Requests(player.perform)], FrameRate()
    )
    try:
        if not stop:
            announce(address, options.browser)
        session = Session(handle, player)
        while not stop:
            session.update()
            time.sleep(_FRAME_TIME)
    finally:
        handle.close()
    return EXIT_SUCCESS
