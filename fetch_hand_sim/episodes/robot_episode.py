"""One episode of one robot among N: the one place where an episode counts, sums up and ends."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.observations import Readings, achieved_goal
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tick import EpisodeStatus, Phase, Tick


@dataclass(frozen=True, slots=True)
class Sensed:
    """What all robots of a simulation sense at one tick, and what it is worth.

    Attributes:
        readings: One reading of the sensors, (N, size) each.
        true_readings: The same without disturbances; None where there are none.
        achieved: (N, goal size).
        desired: (N, goal size).
        reward: (N,).
        success: (N,): whether the goal is reached.
    """

    readings: Readings
    true_readings: Readings | None
    achieved: Array
    desired: Array
    reward: Array
    success: NDArray[np.bool_]


def sense(simulation: Simulation) -> Sensed:
    """Reads the sensors of all robots, once."""
    readings, truth = simulation.readings(), None
    if not simulation.disturbances.is_off:
        truth = simulation.true_readings()
    achieved = achieved_goal(simulation.spec, readings if truth is None else truth)
    desired = simulation.goals.copy()
    reward, success = simulation.metric.evaluate(achieved, desired)
    return Sensed(readings, truth, achieved, desired, reward, success)


def has_ended(ticks: Any, episode_ticks: int, has_diverged: Any) -> Any:
    """Whether an episode is over: time is up or MuJoCo gave it up.

    Args:
        ticks: Steps so far; of many episodes an array.
        episode_ticks: Steps after which time is up.
        has_diverged: Whether MuJoCo gave it up in this step; of many an array.
    """
    return has_diverged | (ticks >= episode_ticks)


class RobotEpisode:
    """From its reset until time is up or MuJoCo gives up.

    Args:
        simulation: The robots.
        episode: Number of the episode in its series.
        seed: Seed of its reset.
        first_stamp_ns: Simulated time of its reset.
        joint_prefix: What the names of joints begin with on the network.

    Attributes:
        seed: As given.
        first_stamp_ns: As given.
        tick: Steps so far.
        has_diverged: Whether MuJoCo gave up, which ends the episode.
        status: What was said last; `waiting` before the reset.
    """

    def __init__(
        self,
        simulation: Simulation,
        episode: int,
        seed: int,
        first_stamp_ns: int,
        joint_prefix: str = JOINT_PREFIX,
    ) -> None:
        self._simulation = simulation
        self._episode = episode
        self._joint_prefix = joint_prefix
        self._period_ns = round(simulation.tick_duration * 1e9)
        self._return = 0.0
        self._disturbances = self._variation = ''
        self.seed = seed
        self.first_stamp_ns = first_stamp_ns
        self.tick = 0
        self.has_diverged = False
        self.status = self._make_status('waiting', is_success=False)

    @property
    def is_finished(self) -> bool:
        """Whether its last tick was made."""
        return self.status.phase == 'finished'

    def start(self, sensed: Sensed, index: int) -> Tick:
        """Returns tick 0, right after the reset.

        Args:
            sensed: By all robots.
            index: Which of them this one is.
        """
        disturbances = self._simulation.disturbances
        if not disturbances.is_off:
            self._disturbances = disturbances.to_json()
            self._variation = json.dumps(self._simulation.variation(index))
        return self._make_tick('reset', sensed, index, None)

    def step(self, sensed: Sensed, index: int, command: Array, has_diverged: bool) -> Tick:
        """Returns the tick that a step led to.

        Args:
            sensed: By all robots, after the step.
            index: Which of them this one is.
            command: (action size,), what was applied.
            has_diverged: Whether MuJoCo gave the robot up in this step.
        """
        self.tick += 1
        self._return += float(sensed.reward[index])
        self.has_diverged = has_diverged
        is_last = has_ended(self.tick, self._simulation.spec.episode_ticks, has_diverged)
        return self._make_tick('finished' if is_last else 'running', sensed, index, command)

    def _make_tick(self, phase: Phase, sensed: Sensed, index: int, command: Array | None) -> Tick:
        is_success, truth = bool(sensed.success[index]), sensed.true_readings
        self.status = self._make_status(phase, is_success=is_success)
        return Tick(
            stamp_ns=self.first_stamp_ns + self.tick * self._period_ns,
            readings={name: values[index] for name, values in sensed.readings.items()},
            desired_goal=sensed.desired[index],
            achieved_goal=sensed.achieved[index],
            reward=None if command is None else float(sensed.reward[index]),
            is_success=is_success,
            applied_command=command,
            status=self.status,
            true_readings=truth and {name: values[index] for name, values in truth.items()},
            has_diverged=self.has_diverged,
        )

    def _make_status(self, phase: Phase, *, is_success: bool) -> EpisodeStatus:
        metric = self._simulation.metric
        return EpisodeStatus(
            task=self._simulation.spec.name,
            episode=self._episode,
            seed=self.seed,
            tick=self.tick,
            phase=phase,
            control_hz=self._simulation.control_hz,
            reward_type=metric.reward_type,
            success_rule=metric.success_rule,
            episode_return=self._return,
            is_success=is_success,
            joint_prefix=self._joint_prefix,
            disturbances=self._disturbances,
            variation=self._variation,
        )
