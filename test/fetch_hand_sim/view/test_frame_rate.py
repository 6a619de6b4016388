"""The frame rate of the page of a robot, with a clock that the test sets."""

import dataclasses

import pytest

from fetch_hand_sim.view.web import FrameRate, Touch


def frames(rate, begin, end, touch=lambda now: Touch(), work=1 / 60):
    """Return the times at which frames begin; each frame takes `work` seconds."""
    now, times = begin, []
    while now < end:
        now += rate.wait_time(now, touch(now))
        times.append(now)
        now += work
    return times


@pytest.mark.parametrize(
    ('touch', 'options', 'count'),
    [
        (Touch(), {}, 60),
        (Touch(), {'work': 0.05}, 40),
        (Touch(wheel=1.0), {}, 120),
        (Touch(is_down=True), {}, 120),
        (Touch(is_typing=True), {}, 120),
    ],
)
def test_frames_are_rare_unless_the_page_is_touched(touch, options, count):
    times = frames(FrameRate(), 10.0, 12.0, lambda now: touch, **options)
    assert len(times) == pytest.approx(count, abs=2)


def test_a_fast_robot_is_drawn_less_often_and_a_moving_mouse_often():
    assert len(frames(FrameRate(lambda: 0.05), 10.0, 12.0)) == pytest.approx(40, abs=2)
    moving = frames(FrameRate(), 10.0, 12.0, lambda now: Touch(mouse=(100.0 * now, 5.0)))
    assert len(moving) == pytest.approx(120, abs=2)


def test_a_resting_pointer_is_ignored():
    rate = FrameRate()
    moved = Touch(mouse=(3.0, 4.0))
    assert len(frames(rate, 10.0, 10.4, lambda now: moved)) == pytest.approx(24, abs=2)
    assert len(frames(rate, 11.0, 12.0, lambda now: moved)) == pytest.approx(30, abs=2)
    clicked = dataclasses.replace(moved, is_down=True)
    assert len(frames(rate, 12.0, 12.4, lambda now: clicked)) == pytest.approx(24, abs=3)
