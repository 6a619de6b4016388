"""Robots without ROS, on a clock that the test moves."""

from __future__ import annotations

from types import SimpleNamespace

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


@pytest.fixture
def make(simulations):
    def make(mode='realtime', task='FetchReach', factor=1.0, episodes=0, answer_wait=0.0):
        clock, ticks = Clock(), []
        runner = EpisodeRunner(simulations[task], episodes=episodes)
        robot = Robot(
            runner,
            CommandBuffer(runner.spec.robot, 0.5, clock),
            TickSchedule(mode, 0.04, factor, clock.now, answer_wait),
            lambda tick, messages: ticks.append((tick, messages)),
            clock,
        )
        return SimpleNamespace(robot=robot, clock=clock, ticks=ticks)

    return make
