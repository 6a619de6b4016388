"""Simulate a logged episode again, from its seed, goals and commands, and compare every bit."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.episode_log import (
    Episode,
    EpisodeReadError,
    EpisodeRecord,
    episode_metadata,
    read_episode,
)
from fetch_hand_sim.episode_log.bag import offered_qos_text
from fetch_hand_sim.episode_log.metadata import RECOVERED
from fetch_hand_sim.episode_log.reader import LoggedTick, logged_topics, split_ticks
from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.recorder import (
    episode_result,
    former_model_sha256,
    mjcf_attachment,
    model_sha256,
)
from fetch_hand_sim.episodes.runner import EpisodeRunner, accept_goal, accept_perturbation
from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.codecs import decode
from msgs_spec.schemas import deserialize, type_hash
from msgs_spec.text import one_line
from msgs_spec.tick import EpisodeStatus, Tick, TickEncoder
from msgs_spec.topics import TopicSpec
from node_runtime.source_revision import source_revision

# Characters of a value in a line.
_LONGEST = 80
# Keys of the record `episode` that name software; another value is a change, not a difference.
_SOFTWARE = ('interface_version', 'model_sha256', 'source_revision')
_COMMANDS = {'commands', 'joint_commands'}
# Keys of the record `episode_result` that do not follow from the simulation.
_NOT_SIMULATED = {'reason', 'received_not_logged', 'late_commands'}


@dataclass(frozen=True, slots=True)
class Difference:
    """Where a recorded episode first differs from the one simulated again.

    Attributes:
        tick: Number of the tick, 0 for the reset.
        stamp_ns: Its recorded stamp.
        field: Topic and field of its message, or another part of the file.
        recorded: Recorded value, shortened.
        simulated: Simulated value, shortened.
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


def _difference(
    tick: int, stamp_ns: int, field: str, recorded: object, simulated: object
) -> Difference:
    given, expected = (one_line(value, longest=_LONGEST) for value in (recorded, simulated))
    return Difference(tick, stamp_ns, one_line(field), given, expected)


@dataclass(slots=True)
class CheckResult:
    """Result of a check.

    Attributes:
        path: The MCAP file.
        ticks: Number of identical ticks.
        messages: Number of messages in them.
        unchecked: Messages of a last tick that was cut off before its command.
        difference: The first difference, or None.
        changed: Software that is not the recorded one: `name recorded -> here`.
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


class _Reference:
    """A simulation with the fingerprints and the text of its model."""

    def __init__(self, record: EpisodeRecord) -> None:
        self.simulation = Simulation(
            record.task.name,
            num_threads=1,
            reward_type=record.reward_type,
            success_rule=record.success_rule,
            control_hz=record.control_hz,
            timing=record.timing,
            disturbances=record.disturbances,
        )
        self.fingerprint = model_sha256(self.simulation.model)
        self.former_fingerprint = former_model_sha256(self.simulation.model)

    @cached_property
    def mjcf(self) -> bytes:
        return mjcf_attachment(self.simulation.asset).data


class EpisodeChecker:
    """Checks one episode after the other; compiles a model only when the task changes."""

    def __init__(self) -> None:
        self._key: tuple[object, ...] = ()
        self._reference: _Reference | None = None

    def check(self, path: Path) -> CheckResult:
        """Check one episode.

        Args:
            path: Bag directory or MCAP file.

        Raises:
            EpisodeReadError: If the file is damaged or ambiguous, or the episode cannot be
                simulated from its records.
        """
        episode = read_episode(path)
        ticks = split_ticks(episode)
        try:
            record = EpisodeRecord.parse(episode.metadata)
            _require_goals(episode)
            reference = self._reference_of(record)
            runner = EpisodeRunner(
                reference.simulation,
                first_seed=record.seed - record.episode,
                first_episode=record.episode,
                first_stamp_ns=ticks[0].stamp_ns,
                joint_prefix=record.joint_prefix,
            )
            result = CheckResult(episode.path)
            start = _start_differences(episode, ticks, runner, reference, result)
            result.difference = next(start, None)
            if result.difference is None:
                _compare(runner, ticks, episode, record, result)
        except (ValueError, KeyError, OverflowError, RuntimeError) as error:
            raise EpisodeReadError(
                f'{episode.path}: cannot be simulated again ({one_line(error)})'
            ) from error
        return result

    def _reference_of(self, record: EpisodeRecord) -> _Reference:
        rules = (record.reward_type, record.success_rule, record.timing, record.disturbances)
        key = (record.task.name, record.control_hz, *rules)
        if self._reference is None or key != self._key:
            self._reference, self._key = _Reference(record), key
        return self._reference


def _start_differences(
    episode: Episode,
    ticks: list[LoggedTick],
    runner: EpisodeRunner,
    reference: _Reference,
    result: CheckResult,
) -> Iterator[Difference]:
    """Yield differences in parts that need no simulation; note changed software in `result`."""
    recorded = episode.metadata
    disturbances = runner.simulation.disturbances
    is_former = recorded.get('model_sha256') == reference.former_fingerprint
    here = episode_metadata(
        runner.spec,
        episode=runner.episode,
        seed=runner.seed,
        reward_type=runner.simulation.metric.reward_type,
        success_rule=runner.simulation.metric.success_rule,
        control_hz=runner.simulation.control_hz,
        timing=runner.simulation.timing,
        model_sha256=reference.former_fingerprint if is_former else reference.fingerprint,
        source_revision=source_revision(),
        disturbances='' if disturbances.is_off else disturbances.to_json(),
    )
    stamp_ns = ticks[0].stamp_ns
    for name, value in here.items():
        is_software = name in _SOFTWARE or name.endswith('_version')
        given = recorded.get(name, value if is_software else 'nothing')
        if given != value and is_software:
            short = one_line(given, longest=12)
            result.changed.append(f'{name.removesuffix("_version")} {short} -> {value[:12]}')
        elif given != value:
            yield _difference(0, stamp_ns, f'metadata {name}', given, value)
    model = episode.attachments.get('model.xml')
    is_same = all(recorded.get(n, here[n]) == here[n] for n in ('model_sha256', 'mujoco_version'))
    if model is not None and is_same and model != reference.mjcf:
        yield _difference(0, stamp_ns, 'attachment model.xml', 'another text', 'the model')
    yield from _topic_differences(episode, ticks)


def _topic_differences(episode: Episode, ticks: list[LoggedTick]) -> Iterator[Difference]:
    """Yield differences of type hash, quality of service, publish times and sequence numbers."""
    stamps = [tick.stamp_ns for tick in ticks]
    for name, spec in logged_topics(episode).items():
        logged = episode.topics[name]
        for what, given, expected in (
            ('type hash', logged.type_hash, type_hash(spec.type_name)),
            ('quality of service', logged.qos_yaml, offered_qos_text(spec.qos)),
        ):
            # Other tools leave them out.
            if given not in ('', '[]', expected):
                yield _difference(0, stamps[0], f'{what} of {name}', given, expected)
        # Other tools write no numbers.
        has_numbers = any(message.sequence for message in logged.messages)
        for number, message in enumerate(logged.messages):
            tick = max(0, bisect_right(stamps, message.log_time_ns) - 1)
            times = message.publish_time_ns, message.log_time_ns
            if times[0] != times[1]:
                yield _difference(tick, stamps[tick], f'publish time of {name}', *times)
            if has_numbers and message.sequence != number:
                where = f'sequence number of {name}'
                yield _difference(tick, stamps[tick], where, message.sequence, number)


def _compare(
    runner: EpisodeRunner,
    ticks: list[LoggedTick],
    episode: Episode,
    record: EpisodeRecord,
    result: CheckResult,
) -> None:
    """Simulate the episode and note in `result` how far it equals the recorded one."""
    encoder = TickEncoder(runner.spec)
    is_recovered = episode.outcome.reason == RECOVERED
    received = _Received(runner, episode, record)
    for number, logged in enumerate(ticks):
        command = _applied_command(logged) if number else runner.resting_command()
        if command is None:
            if logged is not ticks[-1]:
                raise ValueError(f'no applied_command at tick {number}')
            result.unchecked = len(logged.published)
            if episode.is_complete:
                result.difference = _difference(
                    number, logged.stamp_ns, 'topics', 'no applied_command', 'applied_command'
                )
            return
        if number and runner.is_between_episodes:
            result.difference = _difference(
                number, logged.stamp_ns, 'length', f'{len(ticks)} ticks', f'{number} ticks'
            )
            return
        tick = runner.advance(command)
        drawn = episode.metadata.get('variation', '')
        if drawn != tick.status.variation:
            result.difference = _difference(
                number, logged.stamp_ns, 'metadata variation', drawn, tick.status.variation
            )
        else:
            result.difference = received.difference(number, logged, command)
        if result.difference is not None:
            return
        if record.interface_version == 1 and 'fingertip_poses' in tick.readings:
            tick = _without_orientations(tick)
        has_status = logged.find('episode_status') is not None
        expected = encoder.encode(tick, latched=has_status or tick.status.phase != 'running')
        may_be_cut = logged is ticks[-1] and not runner.is_between_episodes
        result.difference = _tick_difference(
            number, logged, tick.stamp_ns, expected, may_be_cut, is_recovered
        )
        if result.difference is not None:
            return
        result.ticks += 1
        result.messages += len(logged.published)
        received.take(logged)
    result.difference = _result_difference(ticks[-1], tick.status, runner, episode)


def _require_goals(episode: Episode) -> None:
    """Raise `ValueError` if goals or pushes were received that the file does not contain."""
    for name in ('set_goal', 'perturb'):
        if name in episode.outcome.received_not_logged:
            raise ValueError(f'the file lacks some of the received messages of {name}')


def _without_orientations(tick: Tick) -> Tick:
    """Remove the fingertip orientations, which robots of interface version 1 did not publish."""
    poses = tick.readings['fingertip_poses'].reshape(-1, 7).copy()
    poses[:, 3:] = [1.0, 0.0, 0.0, 0.0]
    return dataclasses.replace(tick, readings={**tick.readings, 'fingertip_poses': poses.ravel()})


def _result_difference(
    last: LoggedTick, status: EpisodeStatus, runner: EpisodeRunner, episode: Episode
) -> Difference | None:
    """Compare the record `episode_result` with the last tick."""
    expected = episode_result(status)
    expected['complete'] = 'false'
    if runner.is_between_episodes:
        # All ticks of an episode may be there although its end was cut off.
        recorded = episode.result.get('complete')
        expected['complete'] = 'false' if recorded == 'false' else 'true'
    # A file that was cut short may lack all but `complete`.
    missing = {'complete': 'nothing'}
    for name in sorted({*expected, *episode.result.keys() - _NOT_SIMULATED}):
        simulated = expected.get(name, 'nothing')
        recorded = episode.result.get(name, missing.get(name, simulated))
        if recorded != simulated:
            where = f'episode_result {one_line(name, longest=40)}'
            return _difference(status.tick, last.stamp_ns, where, recorded, simulated)
    return None


def _applied_command(logged: LoggedTick) -> Array | None:
    message = logged.find('applied_command')
    if message is None:
        return None
    return decode(message.topic, deserialize(message.topic.type_name, message.data))


class _Received:
    """Applies the logged commands, goals and pushes as `sim_node` does."""

    def __init__(self, runner: EpisodeRunner, episode: Episode, record: EpisodeRecord) -> None:
        self._runner = runner
        self._record = record
        self._commands = CommandBuffer(runner.spec.robot, timeout=0.0)
        outcome = episode.outcome
        is_recovered = outcome.reason == RECOVERED
        self._lacks_commands = is_recovered or bool(_COMMANDS & outcome.received_not_logged.keys())

    def difference(self, number: int, logged: LoggedTick, command: Array) -> Difference | None:
        """Compare the applied command of a tick with the last valid one received before it."""
        if not number:
            self._commands.start_episode(self._runner.resting_command())
        if self._lacks_commands or not self._commands.has_fresh_command:
            return None
        received = self._commands.take()
        if np.array_equal(command, received):
            return None
        return _difference(
            number, logged.stamp_ns, 'applied_command', command, f'{received} received'
        )

    def take(self, logged: LoggedTick) -> None:
        """Apply the messages received after the tick `logged`."""
        for each in logged.received:
            with suppress(ValueError):
                message = deserialize(each.topic.type_name, each.data)
                match each.topic.name:
                    case 'commands':
                        self._commands.accept(message.data)
                    case 'joint_commands':
                        self._commands.accept_named(message.name, message.position)
                    case 'set_goal':
                        reads_header = self._record.interface_version >= 2
                        accept_goal(self._runner, each.topic, message, reads_header=reads_header)
                    case 'perturb':
                        limit = self._record.perturb_limit
                        accept_perturbation(self._runner, each.topic, message, limit)


def _tick_difference(
    number: int,
    logged: LoggedTick,
    stamp_ns: int,
    expected: list[tuple[TopicSpec, bytes]],
    may_be_cut: bool,
    is_recovered: bool,
) -> Difference | None:
    stamp = logged.stamp_ns
    # Recovery may leave out received messages.
    received = [] if is_recovered else logged.received
    names = [message.topic.name for message in logged.published]
    wanted = [topic.name for topic, _ in expected]
    if may_be_cut:
        wanted = wanted[: len(names)]
    if names != wanted:
        return _difference(number, stamp, 'topics', ', '.join(names), ', '.join(wanted))
    for rank, (message, (topic, data)) in enumerate(zip(logged.published, expected, strict=False)):
        if message.data != data:
            where, recorded, simulated = _field_difference(topic, message.data, data)
            return _difference(number, stamp, f'{topic.name}{where}', recorded, simulated)
        if message.log_time_ns != stamp_ns + rank:
            times = message.log_time_ns, stamp_ns + rank
            return _difference(number, stamp, f'log time of {topic.name}', *times)
    for rank, message in enumerate(received, start=len(logged.published)):
        if message.log_time_ns != stamp_ns + rank:
            times = message.log_time_ns, stamp_ns + rank
            return _difference(number, stamp, f'log time of {message.topic.name}', *times)
    return None


def _field_difference(topic: TopicSpec, recorded: bytes, simulated: bytes) -> tuple[str, str, str]:
    """Return the first field in which two messages differ, and its two values."""
    try:
        first, second = (deserialize(topic.type_name, data) for data in (recorded, simulated))
    except ValueError:
        return '', f'{len(recorded)} unreadable bytes', f'{len(simulated)} bytes'
    for (where, one), (other_where, other) in zip(_leaves(first), _leaves(second), strict=False):
        # Text shows every bit of a float64, except those of NaN.
        if (where, repr(one)) != (other_where, repr(other)):
            return where, repr(one), repr(other)
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
