"""The list of episodes says what each is, whatever it is."""

from __future__ import annotations

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.view.page.panels import describe
from support.episode_recorder import Recorder


def test_an_episode_says_how_it_ended(tmp_path):
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    assert describe(path) in (f'{path.name}  reached', f'{path.name}  missed')


def test_what_cannot_be_read_is_listed_all_the_same(tmp_path):
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(b'nothing')
    assert describe(damaged) == 'damaged  unreadable'
    assert describe(tmp_path / 'gone.mcap') == 'gone  unreadable'
