"""The frame rate of the page of a robot, with a clock that the test sets."""

import pytest

from fetch_hand_sim.view.web import FrameRate


def frames(rate, begin, end, mouse=lambda now: (0.0, 0.0), is_held=False, work=1 / 60):
    """Return the times at which frames begin; each frame takes `work` seconds."""
    now, times = begin, []
    while now < end:
        now += rate.wait_time(now, mouse(now), is_held)
        times.append(now)
        now += work
    return times


@pytest.mark.parametrize(
    ('period', 'options', 'count'),
    [
        (1 / 30, {}, 60),
        (1 / 30, {'work': 0.05}, 40),
        # A fast robot is drawn less often.
        (0.05, {}, 40),
        (1 / 30, {'is_held': True}, 120),
        (1 / 30, {'mouse': lambda now: (100.0 * now, 5.0)}, 120),
    ],
)
def test_frames_are_rare_unless_the_page_is_touched(period, options, count):
    times = frames(FrameRate(lambda: period), 10.0, 12.0, **options)
    assert len(times) == pytest.approx(count, abs=2)


def test_a_resting_pointer_is_ignored():
    rate = FrameRate()
    moved = {'mouse': lambda now: (3.0, 4.0)}
    assert len(frames(rate, 10.0, 10.4, **moved)) == pytest.approx(24, abs=2)
    assert len(frames(rate, 11.0, 12.0, **moved)) == pytest.approx(30, abs=2)
    assert len(frames(rate, 12.0, 12.4, **moved, is_held=True)) == pytest.approx(24, abs=3)
