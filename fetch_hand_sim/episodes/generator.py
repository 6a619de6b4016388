"""Run and log many episodes in parallel with the batched simulation.

For the same commands, `sim_node` in lockstep writes the same messages, stamps, log times and
metadata keys.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fetch_hand_sim.episode_log import EpisodeDirectory, EpisodeLogError, EpisodeWriter
from fetch_hand_sim.episode_log.metadata import DIVERGED
from fetch_hand_sim.episodes.recorder import (
    LoggedEpisode,
    RecordingContext,
    episode_result,
)
from fetch_hand_sim.episodes.runner import FIRST_STAMP_NS, RobotEpisode, sense
from fetch_hand_sim.simulation import Observation, Simulation
from msgs_spec.arrays import Array
from msgs_spec.codecs import CommandCodec
from msgs_spec.robots import clip_command, command_from_action
from msgs_spec.tick import Tick, TickEncoder
from msgs_spec.topics import TopicSpec, topic

Act = Callable[[Observation], NDArray[Any]]

# Files that wait for the disk at once.
_COMPLETING_THREADS = 4


@dataclass(frozen=True, slots=True)
class _Robot:
    """One robot of the batch in one episode.

    `ticks` contains stamp (ns) and published messages of each tick, `commands` the command (CDR)
    received after each tick but the last.
    """

    episode: RobotEpisode
    ticks: list[tuple[int, list[tuple[TopicSpec, bytes]]]] = field(default_factory=list)
    commands: list[bytes] = field(default_factory=list)


class EpisodeGenerator:
    """Runs a policy in all N robots of a simulation and logs every episode to `directory`.

    The policy `act` maps observations to actions (N, action size) in [-1, 1]. `on_start` is called
    with the N seeds whenever episodes begin.
    """

    def __init__(
        self,
        simulation: Simulation,
        directory: Path,
        act: Act,
        context: RecordingContext,
        on_start: Callable[[Sequence[int]], object] | None = None,
    ) -> None:
        self._simulation = simulation
        self._episodes = EpisodeDirectory(directory)
        self._act = act
        self._on_start = on_start
        self._context = context
        self._encoder = TickEncoder(simulation.spec)
        self._commands = topic(simulation.spec, 'commands')
        self._command_encoder = CommandCodec(self._commands)
        self._period_ns = round(simulation.tick_duration * 1e9)

    def generate(self, episodes: int, first_seed: int = 0) -> Iterator[LoggedEpisode]:
        """Yield the logged episodes, in order, as their files are completed.

        Episode i has the seed `first_seed + i`. The stamps are as if one robot ran all
        episodes, one after the other. An error of the policy or Ctrl-C is raised after finished
        episodes were yielded.

        Raises:
            EpisodeLogError: If a file cannot be written, after finished episodes were yielded.
        """
        with ThreadPoolExecutor(_COMPLETING_THREADS, 'episode_log') as pool:
            waiting: deque[Future[LoggedEpisode]] = deque()
            try:
                for first in range(0, episodes, self._simulation.num_envs):
                    count = min(self._simulation.num_envs, episodes - first)
                    robots = [self._robot(first + i, first_seed) for i in range(count)]
                    self._run(robots, first_seed + first)
                    yield from _completed(waiting)
                    for robot in robots:
                        waiting.append(pool.submit(_complete, self._write(robot), robot))
                yield from _completed(waiting)
            except (KeyboardInterrupt, Exception):
                while waiting:
                    with suppress(EpisodeLogError):
                        yield from _completed(waiting)
                raise

    def _robot(self, episode: int, first_seed: int) -> _Robot:
        ticks = self._simulation.spec.episode_ticks + 1
        stamp_ns = FIRST_STAMP_NS + episode * ticks * self._period_ns
        return _Robot(RobotEpisode(self._simulation, episode, first_seed + episode, stamp_ns))

    def _run(self, robots: Sequence[_Robot], first_seed: int) -> None:
        """Run one episode in all robots, with seeds from `first_seed` on; record only `robots`."""
        simulation, robot_spec = self._simulation, self._simulation.spec.robot
        simulation.reset(seed=first_seed)
        if self._on_start is not None:
            self._on_start(range(first_seed, first_seed + simulation.num_envs))
        sensed = sense(simulation)
        for index, robot in enumerate(robots):
            self._take(robot, robot.episode.start(sensed, index))
        for _ in range(simulation.spec.episode_ticks):
            observation = simulation.observe_from(sensed.readings)
            actions = self._act({**observation, 'achieved_goal': sensed.achieved})
            commands = np.asarray(command_from_action(robot_spec, actions), dtype=np.float64)
            self._receive(robots, commands)
            applied = clip_command(robot_spec, commands)
            diverged = simulation.advance(applied)
            sensed = sense(simulation)
            for index, robot in enumerate(robots):
                if not robot.episode.is_finished:
                    has_diverged = bool(diverged[index])
                    tick = robot.episode.step(sensed, index, applied[index], has_diverged)
                    self._take(robot, tick)

    def _take(self, robot: _Robot, tick: Tick) -> None:
        """Encode the messages of a tick and append them to `robot.ticks`."""
        messages = self._encoder.encode(tick, latched=tick.status.phase != 'running')
        robot.ticks.append((tick.stamp_ns, messages))

    def _receive(self, robots: Sequence[_Robot], commands: Array) -> None:
        """Encode commands (N, action size) as CDR and append each to `commands` of its robot."""
        for robot, command in zip(robots, commands, strict=False):
            if not robot.episode.is_finished:
                stamp_ns, _ = robot.ticks[-1]
                robot.commands.append(self._command_encoder.encode(stamp_ns, command))

    def _write(self, robot: _Robot) -> EpisodeWriter:
        status = robot.episode.status
        writer = self._episodes.begin(
            status.task,
            status.seed,
            self._context.metadata(status),
            self._context.attachments,
        )
        try:
            for (stamp_ns, messages), command in zip_longest(robot.ticks, robot.commands):
                writer.write_tick(stamp_ns, messages)
                if command is not None:
                    writer.write_received(self._commands, command)
        except KeyboardInterrupt:
            # The episode is whole, and its file would be marked as interrupted.
            writer.discard()
            raise
        robot.ticks.clear()
        robot.commands.clear()
        return writer


def _completed(waiting: deque[Future[LoggedEpisode]]) -> Iterator[LoggedEpisode]:
    """Wait for the results and yield them in order; `waiting` keeps those not yet yielded."""
    while waiting:
        # An interrupted wait leaves the result in `waiting`.
        waiting[0].exception()
        yield waiting.popleft().result()


def _complete(writer: EpisodeWriter, robot: _Robot) -> LoggedEpisode:
    status, is_complete = robot.episode.status, not robot.episode.has_diverged
    writer.end(episode_result(status), None if is_complete else DIVERGED)
    path = writer.store()
    if path is None:
        raise EpisodeLogError(f'episode of seed {status.seed} could not be written')
    return LoggedEpisode(status, path, is_complete)
