"""The latest tick, for those who only look, on a clock that the test moves."""

from __future__ import annotations

import pytest

from fetch_hand_sim.sim_node.schedule import LatestTick
from msgs_spec.codecs import decode_status
from msgs_spec.schemas import deserialize
from msgs_spec.tick import EpisodeStatus, TickEncoder, split_messages
from msgs_spec.topics import LATEST_TICKS_PER_SECOND


class Output:
    """A publisher with so many listeners."""

    def __init__(self) -> None:
        self.listeners, self.said = 1, []

    def publish(self, msg: bytes) -> None:
        message = split_messages(msg)['episode_status']
        values = decode_status(deserialize('diagnostic_msgs/msg/DiagnosticArray', message))
        self.said.append(EpisodeStatus.from_values(values).tick)

    def get_subscription_count(self) -> int:
        return self.listeners


@pytest.fixture
def case(make):
    case = make('lockstep')
    case.output = Output()
    encoder = TickEncoder(case.robot.runner.spec)
    case.latest = LatestTick(case.output, encoder, case.clock)

    def tick(seconds: float) -> None:
        case.clock.now += seconds
        case.robot.tick()
        case.latest.take(*case.ticks[-1])

    case.tick = tick
    return case


def test_a_fast_robot_is_published_at_a_limited_rate_and_a_slow_one_at_every_tick(case) -> None:
    for _ in range(50):
        case.tick(0.002)
    assert len(case.output.said) <= 0.1 * LATEST_TICKS_PER_SECOND + 2
    case.output.said.clear()
    # 25 Hz; some ticks are late, the next ones in time.
    for late in (0.0, 0.03, 0.0, 0.0, 0.03):
        case.tick(0.04 + late)
        case.tick(0.04 - late)
    assert len(case.output.said) == 10


def test_the_last_tick_before_a_standstill_is_published_once(case) -> None:
    for _ in range(3):
        case.tick(0.001)
    case.clock.now += 1.0
    case.latest.publish_when_due()
    case.latest.publish_when_due()
    assert case.output.said[-1] == 2 and len(case.output.said) == len(set(case.output.said))
    case.clock.now += 1.0
    case.latest.repeat()
    case.latest.publish_when_due()
    assert case.output.said[-2:] == [2, 2]


def test_without_subscribers_nothing_is_published_and_late_ones_receive_the_last_tick(case) -> None:
    case.latest.publish_when_due()
    case.output.listeners = 0
    for _ in range(5):
        case.tick(0.1)
    assert case.output.said == []
    case.output.listeners, case.clock.now = 1, case.clock.now + 0.1
    case.latest.publish_when_due()
    assert case.output.said == [4]
