"""Run the episodes of one robot tick by tick; each command leads to a `Tick`.

This module uses no ROS, files or wall-clock time. So real time, lockstep and a Python loop give the
same ticks for the same commands.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.codecs import check_frame, decode, message_stamp
from msgs_spec.disturbances import Disturbances
from msgs_spec.observations import Readings, achieved_goal
from msgs_spec.parameters import episode_seed
from msgs_spec.robots import JOINT_PREFIX
from msgs_spec.tick import EpisodeStatus, Phase, Tick
from msgs_spec.topics import TopicSpec

# Simulated time of the first tick. Not 0, because ROS takes a time of 0 for "no time yet".
FIRST_STAMP_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class Sensed:
    """Readings, goals and rewards of all N robots of a simulation at one tick.

    Attributes:
        readings: Sensor readings by name, (N, size) each.
        true_readings: Readings without disturbances; None if disturbances are off.
        achieved: Achieved goals by the undisturbed readings, (N, goal size).
        desired: Desired goals, (N, goal size).
        reward: (N,).
        success: (N,) whether the goal is reached at this tick.
    """

    readings: Readings
    true_readings: Readings | None
    achieved: Array
    desired: Array
    reward: Array
    success: NDArray[np.bool_]


def sense(simulation: Simulation) -> Sensed:
    """Read the sensors and goals of all robots and compute their rewards."""
    readings, truth = simulation.readings(), None
    if not simulation.disturbances.is_off:
        truth = simulation.true_readings()
    achieved = achieved_goal(simulation.spec, readings if truth is None else truth)
    desired = simulation.goals.copy()
    reward, success = simulation.metric.evaluate(achieved, desired)
    return Sensed(readings, truth, achieved, desired, reward, success)


def has_ended(ticks: Any, episode_ticks: int, has_diverged: Any) -> Any:
    """Return whether an episode reached `episode_ticks` or diverged; for arrays, elementwise."""
    return has_diverged | (ticks >= episode_ticks)


class RobotEpisode:
    """Makes the ticks of one episode of a robot; call `start` after the reset, then `step`."""

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
        """True after the last tick of the episode."""
        return self.status.phase == 'finished'

    def start(self, sensed: Sensed, index: int) -> Tick:
        """Return tick 0 of robot `index`; `sensed` was read from all robots after the reset."""
        disturbances = self._simulation.disturbances
        if not disturbances.is_off:
            self._disturbances = disturbances.to_json()
            self._variation = json.dumps(self._simulation.variation(index))
        return self._make_tick('reset', sensed, index, None)

    def step(self, sensed: Sensed, index: int, command: Array, has_diverged: bool) -> Tick:
        """Return the tick of robot `index` after a step that applied `command` (action size,)."""
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


class EpisodeRunner:
    """Runs episodes one after the other on a `Simulation` of one robot.

    The reset of an episode is a tick, too. Episode i has the seed `first_seed + i` until
    `set_next_seed` is called. Stamps grow by one period per tick and never go back.

    Args:
        episodes: Number of episodes to run; 0 for no end.
        first_episode: Index of the first episode. To repeat one episode of a series, pass its index
            here and its first stamp as `first_stamp_ns`.
        first_stamp_ns: Simulated time of the first tick.

    Attributes:
        spec: The task, with the joint names of the messages.
        episode: Index of the running or next episode, from 0.
        current: The running or last episode; before the first tick the first episode, in the phase
            `waiting`.
        stamp_ns: Simulated time of the last tick; one period before `first_stamp_ns` at first.
        is_between_episodes: Whether the next tick is a reset.
    """

    def __init__(
        self,
        simulation: Simulation,
        *,
        first_seed: int = 0,
        episodes: int = 0,
        first_episode: int = 0,
        first_stamp_ns: int = FIRST_STAMP_NS,
        joint_prefix: str = JOINT_PREFIX,
    ) -> None:
        if simulation.num_envs != 1:
            raise ValueError(f'one robot is run at a time, not {simulation.num_envs}')
        self.simulation = simulation
        self.spec = simulation.spec.with_joint_prefix(joint_prefix)
        self._joint_prefix = joint_prefix
        self._first_seed = first_seed
        self._episodes = episodes
        self._period_ns = round(simulation.tick_duration * 1e9)
        self._first_stamp_ns = first_stamp_ns
        self.stamp_ns = first_stamp_ns - self._period_ns
        self._first_episode = self.episode = first_episode
        self._series_seed = first_seed
        self._new_first_seed: int | None = None
        self._new_disturbances: Disturbances | None = None
        self.is_between_episodes = True
        self.current = self._make_episode(first_stamp_ns)

    @property
    def is_done(self) -> bool:
        """True if all requested episodes are finished."""
        return 0 < self._episodes <= self.episode - self._first_episode

    @property
    def seed(self) -> int:
        """Seed of the running or next episode."""
        first = self._first_seed
        if self.is_between_episodes and self._new_first_seed is not None:
            first = self._new_first_seed
        return episode_seed(first, self.episode)

    @property
    def has_started(self) -> bool:
        """True after the first tick."""
        return self.stamp_ns >= self._first_stamp_ns

    def waiting_status(self) -> EpisodeStatus:
        """Return the status to publish before the first episode starts."""
        return self._make_episode(self.stamp_ns).status

    def resting_command(self) -> Array:
        """Return the command (action size,) at which the robot stays in its present position."""
        (command,) = self.simulation.resting_commands()
        return np.asarray(command)

    def set_next_seed(self, seed: int) -> None:
        """Set the seed of the next episode; the seed grows by 1 with each later episode."""
        following = self.episode if self.is_between_episodes else self.episode + 1
        self._new_first_seed = seed - following
        self._series_seed = seed - self._first_episode

    def set_next_disturbances(self, disturbances: Disturbances) -> None:
        """Set the disturbances of all episodes that start from now on."""
        self._new_disturbances = disturbances

    def end_episode(self) -> None:
        """End the running episode, if any; the next tick is the reset of the next episode."""
        if not self.is_between_episodes:
            self._finish()

    def start_over(self) -> None:
        """Make the next tick the reset of the first episode; stamps continue to grow.

        The first episode has the first seed, or the seed of the last `set_next_seed`.
        """
        self.is_between_episodes = True
        self.episode = self._first_episode
        self._first_seed, self._new_first_seed = self._series_seed, None

    def advance(self, command: Array) -> Tick:
        """Advance by one tick: the reset of the next episode, or one step of the running one.

        `command` (action size,) is in command units and within limits; a reset ignores it.
        """
        tick = self._reset() if self.is_between_episodes else self._step(command)
        self.stamp_ns = tick.stamp_ns
        return tick

    def _reset(self) -> Tick:
        stamp_ns = self.stamp_ns + self._period_ns
        if self._new_first_seed is not None:
            self._first_seed, self._new_first_seed = self._new_first_seed, None
        if self._new_disturbances is not None:
            self.simulation.disturbances, self._new_disturbances = self._new_disturbances, None
        self.is_between_episodes = False
        self.simulation.reset(seed=self.seed)
        self.current = self._make_episode(stamp_ns)
        return self.current.start(sense(self.simulation), 0)

    def _step(self, command: Array) -> Tick:
        (diverged,) = self.simulation.advance(command[None])
        sensed = sense(self.simulation)
        tick = self.current.step(sensed, 0, command.copy(), bool(diverged))
        if self.current.is_finished:
            self._finish()
        return tick

    def _finish(self) -> None:
        self.is_between_episodes = True
        self.episode += 1

    def _make_episode(self, stamp_ns: int) -> RobotEpisode:
        return RobotEpisode(self.simulation, self.episode, self.seed, stamp_ns, self._joint_prefix)


# Rules by which a robot accepts goals and pushes; the check of its log applies the same rules

# Metres. Goals beyond overflow in distances and rewards sooner or later.
FARTHEST_GOAL = 1000.0
# Newton metres of torque for each newton of force: fingers are about as long, in metres.
_LEVER = 0.1
_WITHIN = 1.0 - 1e-9


def accept_goal(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, *, reads_header: bool = True
) -> None:
    """Replace the goal of the running episode from the next tick on.

    `reads_header=False` ignores frame and stamp, as robots of interface version 1 did. ValueError
    without a running episode, or if the frame, the stamp or the goal in `message` is invalid.
    """
    if runner.is_between_episodes:
        raise ValueError('no episode is running')
    if reads_header:
        check_frame(topic, message.header.frame_id)
        _check_stamp(runner, message_stamp(message))
    goal = decode(topic, message)
    beyond = np.abs(goal) > FARTHEST_GOAL
    if beyond.any():
        allowed = f'-{FARTHEST_GOAL:g} ... {FARTHEST_GOAL:g}'
        raise ValueError(f'{goal[beyond][0]:g} given; allowed: {allowed}')
    runner.simulation.set_goal(goal[None])


def _check_stamp(runner: EpisodeRunner, stamp_ns: int) -> None:
    """Raise ValueError unless a goal's stamp, ns, is 0 or lies in the running episode until now."""
    first, last = runner.current.first_stamp_ns, runner.stamp_ns
    if stamp_ns and not first <= stamp_ns <= last:
        raise ValueError(
            f'stamp {stamp_ns / 1e9:.3f} s given; allowed: 0, or simulated time of the running '
            f'episode, {first / 1e9:.3f} ... {last / 1e9:.3f} s'
        )


def bounded_wrench(wrench: Array, limit: float) -> Array:
    """Scale a wrench (6,), N and N m, down if its force or torque is beyond the limits.

    `limit` is the largest force, N; the largest torque is 0.1 m times `limit`. Directions stay.
    """
    force, torque = _sizes(wrench)
    share = max(force / limit, torque / (_LEVER * limit))
    # Slightly within the limit, so that rounding does not exceed it.
    return wrench if share <= _WITHIN else wrench * (_WITHIN / share)


def accept_perturbation(
    runner: EpisodeRunner, topic: TopicSpec, message: Any, limit: float
) -> None:
    """Push the body `message.header.frame_id` with the wrench of `message` in the next step.

    `limit` is the largest force, N, or 0 for no pushes; the largest torque is 0.1 m times `limit`.
    ValueError beyond these, without a running episode, or for a body that cannot move.
    """
    if not limit:
        raise ValueError('perturbations are off; perturb_limit:=10.0 at the start allows 10 N')
    if runner.is_between_episodes:
        raise ValueError('no episode is running')
    wrench = decode(topic, message)
    force, torque = _sizes(wrench)
    # Written so that NaN is rejected too.
    if not (force <= limit and torque <= _LEVER * limit):
        raise ValueError(
            f'{force:g} N and {torque:g} N m given; allowed: up to {limit:g} N and '
            f'{_LEVER * limit:g} N m'
        )
    runner.simulation.perturb(message.header.frame_id, wrench)


def _sizes(wrench: Array) -> tuple[float, float]:
    """Return the magnitudes of the force, N, and of the torque, N m, of a wrench (6,)."""
    # A number too large to be squared is beyond every limit.
    with np.errstate(over='ignore'):
        return float(np.linalg.norm(wrench[:3])), float(np.linalg.norm(wrench[3:]))
