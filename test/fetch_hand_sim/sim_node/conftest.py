"""Robots without ROS, on a clock that the test moves."""

from __future__ import annotations

import pytest

from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.sim_node.robot import Robot
from fetch_hand_sim.sim_node.schedule import TickSchedule
from fetch_hand_sim.simulation import Simulation


class Clock:
    """A steady clock that the test moves."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture(scope='session')
def simulations():
    return {name: Simulation(name, num_threads=1) for name in ('FetchReach', 'HandReach')}


class Case:
    """A robot, the clock that the test moves, and what was published."""

    def __init__(self, simulation, mode, factor, episodes, answer_wait):
        self.clock, self.ticks = Clock(), []
        runner = EpisodeRunner(simulation, episodes=episodes)
        self.robot = Robot(
            runner,
            CommandBuffer(runner.spec.robot, 0.5, self.clock),
            TickSchedule(mode, 0.04, factor, self.clock.now, answer_wait),
            lambda tick, messages: self.ticks.append((tick, messages)),
            self.clock,
        )

    @property
    def last(self):
        """The last tick."""
        return self.ticks[-1][0]

    @property
    def place(self):
        """Episode and tick of the robot."""
        return self.last.status.episode, self.last.status.tick

    def command(self, value=0.1, stamp_ns=None):
        self.robot.buffer.accept([value] * 4, stamp_ns)

    def tick_after(self, seconds):
        """Move the clock and run the tick that is due then."""
        self.clock.now += seconds
        self.robot.tick_when_due()


@pytest.fixture
def make(simulations):
    def make(mode='realtime', task='FetchReach', factor=1.0, episodes=0, answer_wait=0.0):
        return Case(simulations[task], mode, factor, episodes, answer_wait)

    return make
