"""A finished episode for the tests of everything that reads one."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope='session')
def finished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished FetchReach episode, which tests copy and never change."""
    # Imported late: the environment of ROS is set before message classes are imported.
    from fetch_hand_sim.episode_log import EpisodeDirectory
    from support.episode_recorder import Recorder

    return Recorder('FetchReach').record(EpisodeDirectory(tmp_path_factory.mktemp('finished')))
