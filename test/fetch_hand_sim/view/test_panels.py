"""Layout of the panels, and the list of episodes."""

from __future__ import annotations

from contextlib import contextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest

from fetch_hand_sim.episode_log import EpisodeDirectory
from fetch_hand_sim.view.page import panels
from fetch_hand_sim.view.page.panels import describe
from fetch_hand_sim.view.page.widgets import MARGIN, WIDTH, Windows
from fetch_hand_sim.view.picture import Picture, Timeline
from support.episode_recorder import Recorder

HEIGHT = 180.0
EPISODES = (Path('a'), Path('b'))
TIMELINE = Timeline(time=0.0, title='a', number=0, count=2)


class Drawn(Windows):
    """Windows that say where they are and draw nothing."""

    def __init__(self):
        super().__init__()
        self.places = {}

    @contextmanager
    def column(self, title, x, y, height=0.0):
        name = title.partition('###')[0]
        is_shown = name not in self._hidden
        self.places[name] = x, y, is_shown
        yield is_shown


@pytest.fixture
def places_on(monkeypatch):
    """Draws a page of some width, several times; returns where its windows are."""
    drawn = Drawn()
    monkeypatch.setattr(panels, 'Windows', lambda: drawn)
    monkeypatch.setattr(panels, 'untitled_window', lambda *_: nullcontext(True))
    for name in ('draw_plots', 'draw_timeline'):
        monkeypatch.setattr(panels, name, lambda *_: None)
    monkeypatch.setattr(panels.RobotPanel, 'draw', lambda *_: None)
    monkeypatch.setattr(panels.EpisodeList, 'draw', lambda *_: None)
    page = panels.Panels(None, EPISODES)

    def draw(width):
        window = SimpleNamespace(y=HEIGHT)
        io = SimpleNamespace(DisplaySize=SimpleNamespace(x=width, y=800.0))
        fake = SimpleNamespace(GetIO=lambda: io, GetWindowSize=lambda: window)
        monkeypatch.setattr(panels, 'imgui', fake)
        page.draw(Picture('FetchPush', timeline=TIMELINE))
        return drawn

    return draw


def test_a_page_with_room_shows_everything_side_by_side(places_on):
    places = places_on(960.0).places
    assert all(is_shown for *_, is_shown in places.values())
    assert places['Curves'][:2] == (960.0 - WIDTH - MARGIN, MARGIN)
    assert places['Episodes'][:2] == (MARGIN, HEIGHT + 2.0 * MARGIN)


def test_on_a_telephone_nothing_lies_on_another_and_the_robot_is_seen(places_on):
    drawn = places_on(390.0)
    seen = [drawn.places[name] for name in ('FetchPush', 'Curves', 'Episodes')]
    x, y, is_shown = zip(*seen, strict=True)
    assert x == (MARGIN,) * 3 and is_shown == (True, False, False)
    assert y[1] >= y[0] + HEIGHT and y[2] > y[1] + 2.0 * MARGIN
    # A panel that the user opens stays open.
    drawn._hidden.discard('Curves')
    places = places_on(390.0).places
    assert places['Curves'][2] and places['Episodes'][1] >= places['Curves'][1] + HEIGHT


def test_the_metadata_of_an_episode_contain_its_ending(tmp_path):
    path = Recorder('FetchReach').record(EpisodeDirectory(tmp_path))
    assert describe(path) in (f'{path.name}  reached', f'{path.name}  missed')


def test_unreadable_files_are_listed(tmp_path):
    damaged = tmp_path / 'damaged.mcap'
    damaged.write_bytes(b'nothing')
    assert describe(damaged) == 'damaged  unreadable'
    assert describe(tmp_path / 'gone.mcap') == 'gone  unreadable'
