"""How often the page of a robot is built, by a clock that is told what time it is."""

import dataclasses

import pytest

from fetch_hand_sim.view.web import FrameRate, Touch


def frames(rate, begin, end, touch=lambda now: Touch(), work=1 / 60):
    """Times at which frames begin, each of which takes a while."""
    now, times = begin, []
    while now < end:
        now += rate.wait_time(now, touch(now))
        times.append(now)
        now += work
    return times


def test_nobody_touches_the_page():
    assert len(frames(FrameRate(), 10.0, 12.0)) == pytest.approx(60, abs=2)


def test_a_robot_in_a_hurry_is_shown_less_often():
    assert len(frames(FrameRate(lambda: 0.05), 10.0, 12.0)) == pytest.approx(40, abs=2)


def test_a_frame_that_takes_longer_is_followed_at_once():
    assert len(frames(FrameRate(), 10.0, 12.0, work=0.05)) == 40


@pytest.mark.parametrize(
    'touch',
    [
        lambda now: Touch(mouse=(100.0 * now, 5.0)),
        lambda now: Touch(wheel=1.0),
        lambda now: Touch(is_down=True),
        lambda now: Touch(is_typing=True),
    ],
    ids=['moving', 'turning', 'holding', 'typing'],
)
def test_a_hand_at_the_page(touch):
    assert len(frames(FrameRate(), 10.0, 12.0, touch)) == pytest.approx(120, abs=2)


def test_a_hand_that_rests_is_forgotten():
    rate = FrameRate()
    moved = Touch(mouse=(3.0, 4.0))
    assert len(frames(rate, 10.0, 10.4, lambda now: moved)) == pytest.approx(24, abs=2)
    assert len(frames(rate, 11.0, 12.0, lambda now: moved)) == pytest.approx(30, abs=2)
    clicked = dataclasses.replace(moved, is_down=True)
    assert len(frames(rate, 12.0, 12.4, lambda now: clicked)) == pytest.approx(24, abs=3)
