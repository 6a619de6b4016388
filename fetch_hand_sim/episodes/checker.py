"""Runs a logged episode again, from its seed, goals and commands, and compares every bit."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.episode_log import Episode, EpisodeReadError, episode_metadata, read_episode
from fetch_hand_sim.episode_log.episode_record import EpisodeRecord
from fetch_hand_sim.episode_log.model import former_model_sha256, model_sha256
from fetch_hand_sim.episode_log.reader import DAMAGED
from fetch_hand_sim.episode_log.ticks import LoggedTick, split_ticks
from fetch_hand_sim.episodes.goals import accept_goal
from fetch_hand_sim.episodes.perturbations import accept_perturbation
from fetch_hand_sim.episodes.recorder import episode_result
from fetch_hand_sim.episodes.runner import EpisodeRunner
from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.codecs import decode
from msgs_spec.schemas import deserialize
from msgs_spec.text import one_line, printable
from msgs_spec.tick import EpisodeStatus, Tick, TickEncoder
from msgs_spec.topics import TopicSpec
from node_runtime.source_revision import source_revision


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a recorded episode first differs from the one simulated again.

    Attributes:
        tick: Number of the tick, 0 for the reset.
        stamp_ns: Its recorded stamp.
        field: Topic, and the field of its message if there is one.
        recorded: What the file says.
        simulated: What the simulation says.
    """

    tick: int
    stamp_ns: int
    field: str
    recorded: str
    simulated: str

    def __str__(self) -> str:
        return (
            f'tick {self.tick} ({self.stamp_ns / 1e9:.3f} s), {self.field}: recorded '
            f'{self.recorded}, simulated {self.simulated}'
        )


@dataclass(slots=True)
class CheckResult:
    """What came out.

    Attributes:
        path: The MCAP file.
        ticks: Ticks that are identical.
        messages: Messages in them that are identical.
        unchecked: Messages of a last tick that was cut off before its command.
        difference: The first difference, None if there is none.
        changed: What the file was written with and is different here: `name recorded -> here`.
    """

    path: Path
    ticks: int = 0
    messages: int = 0
    unchecked: int = 0
    difference: Difference | None = None
    changed: list[str] = field(default_factory=list)

    def __str__(self) -> str:
        changes = f'; changed since: {", ".join(self.changed)}' if self.changed else ''
        if self.difference is not None:
            return f'{self.path}: differs at {self.difference}{changes}'
        rest = f', {self.unchecked} of a cut-off tick not checked' if self.unchecked else ''
        counts = f'{self.ticks} ticks, {self.messages} messages'
        return f'{self.path}: identical, {counts}{rest}{changes}'


class EpisodeChecker:
    """Checks one episode after the other; compiles a model only when the task changes."""

    def __init__(self) -> None:
        self._key: tuple[object, ...] = ()
        self._simulation: Simulation | None = None
        self._fingerprint = self._former_fingerprint = ''

    def check(self, path: Path) -> CheckResult:
        """Checks one episode.

        Args:
            path: Bag directory or MCAP file.

        Raises:
            EpisodeReadError: If the file is damaged, or does not say how to run the episode again.
        """
        episode = read_episode(path)
        ticks = split_ticks(episode)
        try:
            record = EpisodeRecord.parse(episode.metadata)
            _require_goals(episode)
            runner = EpisodeRunner(
                self._simulation_of(record),
                first_seed=record.seed - record.episode,
                first_episode=record.episode,
                first_stamp_ns=ticks[0].stamp_ns,
                joint_prefix=record.joint_prefix,
            )
            result = CheckResult(episode.path, changed=self._changes(episode, runner))
            _compare(runner, ticks, episode, record, result)
        except DAMAGED as error:
            raise EpisodeReadError(
                f'{episode.path}: cannot be run again ({one_line(error)})'
            ) from error
        return result

    def _simulation_of(self, record: EpisodeRecord) -> Simulation:
        rules = (record.reward_type, record.success_rule, record.timing, record.disturbances)
        key = (record.task.name, record.control_hz, *rules)
        if self._simulation is None or key != self._key:
            self._simulation = Simulation(
                record.task.name,
                num_threads=1,
                reward_type=record.reward_type,
                success_rule=record.success_rule,
                control_hz=record.control_hz,
                timing=record.timing,
                disturbances=record.disturbances,
            )
            self._key = key
            model = self._simulation.model
            self._fingerprint = model_sha256(model)
            self._former_fingerprint = former_model_sha256(model)
        return self._simulation

    def _changes(self, episode: Episode, runner: EpisodeRunner) -> list[str]:
        recorded = episode.metadata
        is_former = recorded.get('model_sha256') == self._former_fingerprint
        here = episode_metadata(
            runner.spec,
            episode=runner.episode,
            seed=runner.seed,
            reward_type=runner.simulation.metric.reward_type,
            success_rule=runner.simulation.metric.success_rule,
            control_hz=runner.simulation.control_hz,
            timing=runner.simulation.timing,
            model_sha256=self._former_fingerprint if is_former else self._fingerprint,
            source_revision=source_revision(),
        )
        return [
            f'{name.removesuffix("_version")} {printable(recorded[name])[:12]} -> {value[:12]}'
            for name, value in here.items()
            if recorded.get(name, value) != value
        ]


def _compare(
    runner: EpisodeRunner,
    ticks: list[LoggedTick],
    episode: Episode,
    record: EpisodeRecord,
    result: CheckResult,
) -> None:
    """Runs the episode and notes how far it is the recorded one."""
    encoder = TickEncoder(runner.spec)
    for number, logged in enumerate(ticks):
        command = _applied_command(logged) if number else runner.resting_command()
        if command is None:
            if logged is not ticks[-1]:
                raise ValueError(f'no applied_command at tick {number}')
            result.unchecked = len(logged.published)
            return
        if number and runner.is_between_episodes:
            result.difference = Difference(
                number, logged.stamp_ns, 'length', f'{len(ticks)} ticks', f'{number} ticks'
            )
            return
        tick = runner.advance(command)
        if record.interface_version == 1 and 'fingertip_poses' in tick.readings:
            tick = _without_orientations(tick)
        has_status = logged.find('episode_status') is not None
        expected = encoder.encode(tick, latched=has_status or tick.status.phase != 'running')
        may_be_cut = logged is ticks[-1] and not runner.is_between_episodes
        result.difference = _tick_difference(number, logged, tick.stamp_ns, expected, may_be_cut)
        if result.difference is not None:
            return
        result.ticks += 1
        result.messages += len(logged.published)
        _take_received(runner, logged, record)
    result.difference = _result_difference(ticks[-1], tick.status, runner, episode)


def _require_goals(episode: Episode) -> None:
    """Raises `ValueError` if goals or pushes were received that the file could not take."""
    for name, what in (('set_goal', 'goals were set'), ('perturb', 'pushes came')):
        if name in episode.outcome.received_not_logged:
            raise ValueError(f'more {what} than the file holds')


def _without_orientations(tick: Tick) -> Tick:
    """The tick as robots of interface version 1 told it: fingertips without orientation."""
    poses = tick.readings['fingertip_poses'].reshape(-1, 7).copy()
    poses[:, 3:] = [1.0, 0.0, 0.0, 0.0]
    return dataclasses.replace(tick, readings={**tick.readings, 'fingertip_poses': poses.ravel()})


def _result_difference(
    last: LoggedTick, status: EpisodeStatus, runner: EpisodeRunner, episode: Episode
) -> Difference | None:
    """Whether the record `episode_result` says something else than the last tick."""
    expected = episode_result(status)
    expected['complete'] = 'false'
    if runner.is_between_episodes:
        # All ticks of an episode may be there although its end was cut off.
        recorded = episode.result.get('complete')
        expected['complete'] = 'false' if recorded == 'false' else 'true'
    for name, simulated in expected.items():
        recorded = episode.result.get(name, simulated)
        if recorded != simulated:
            where = f'episode_result {name}'
            return Difference(
                status.tick, last.stamp_ns, where, printable(recorded)[:80], simulated
            )
    return None


def _applied_command(logged: LoggedTick) -> Array | None:
    message = logged.find('applied_command')
    if message is None:
        return None
    return decode(message.topic, deserialize(message.topic.type_name, message.data))


def _take_received(runner: EpisodeRunner, logged: LoggedTick, record: EpisodeRecord) -> None:
    """Does what the node did with the goals and pushes it received."""
    for message in logged.received:
        if message.topic.name == 'set_goal':
            with suppress(ValueError):
                goal = deserialize(message.topic.type_name, message.data)
                accept_goal(runner, message.topic, goal, reads_header=record.interface_version >= 2)
        elif message.topic.name == 'perturb':
            with suppress(ValueError):
                push = deserialize(message.topic.type_name, message.data)
                accept_perturbation(runner, message.topic, push, record.perturb_limit)


def _tick_difference(
    number: int,
    logged: LoggedTick,
    stamp_ns: int,
    expected: list[tuple[TopicSpec, bytes]],
    may_be_cut: bool,
) -> Difference | None:
    def difference(field: str, recorded: object, simulated: object) -> Difference:
        return Difference(number, logged.stamp_ns, field, str(recorded), str(simulated))

    names = [message.topic.name for message in logged.published]
    wanted = [topic.name for topic, _ in expected]
    if may_be_cut:
        wanted = wanted[: len(names)]
    if names != wanted:
        return difference('topics', ', '.join(names), ', '.join(wanted))
    for rank, (message, (topic, data)) in enumerate(zip(logged.published, expected, strict=False)):
        if message.data != data:
            where, recorded, simulated = _field_difference(topic, message.data, data)
            return difference(f'{topic.name}{where}', recorded, simulated)
        if message.log_time_ns != stamp_ns + rank:
            return difference(f'log time of {topic.name}', message.log_time_ns, stamp_ns + rank)
    return None


def _field_difference(topic: TopicSpec, recorded: bytes, simulated: bytes) -> tuple[str, str, str]:
    """The first field in which two messages differ, and its two values."""
    try:
        first, second = (deserialize(topic.type_name, data) for data in (recorded, simulated))
    except ValueError:
        return '', f'{len(recorded)} unreadable bytes', f'{len(simulated)} bytes'
    for (where, one), (other_where, other) in zip(_leaves(first), _leaves(second), strict=False):
        # Text shows every bit of a float64, except those of NaN.
        if (where, repr(one)) != (other_where, repr(other)):
            return where, printable(repr(one))[:80], repr(other)[:80]
    return '', f'{len(recorded)} bytes', f'{len(simulated)} bytes of other length or padding'


def _leaves(value: Any, where: str = '') -> Iterator[tuple[str, Any]]:
    if dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            if item.name != '__msgtype__':
                yield from _leaves(getattr(value, item.name), f'{where}.{item.name}')
    elif isinstance(value, np.ndarray | list):
        yield f'{where} length', len(value)
        for index, element in enumerate(value):
            yield from _leaves(element, f'{where}[{index}]')
    else:
        yield where, value
