"""Simulate a logged episode again, from its seed, goals and commands, and compare every bit."""

from __future__ import annotations

import dataclasses
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache, partial
from itertools import chain, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from fetch_hand_sim.episode_log import (
    Episode,
    EpisodeReadError,
    EpisodeRecord,
    read_episode,
)
from fetch_hand_sim.episode_log.bag import offered_qos_text
from fetch_hand_sim.episode_log.metadata import RECOVERED
from fetch_hand_sim.episode_log.reader import LoggedTick, TickMessage, logged_topics, split_ticks
from fetch_hand_sim.episodes.command_buffer import CommandBuffer
from fetch_hand_sim.episodes.recorder import RecordingContext, episode_result, former_model_sha256
from fetch_hand_sim.episodes.runner import EpisodeRunner, accept_goal, accept_perturbation
from fetch_hand_sim.simulation import Simulation
from msgs_spec.arrays import Array
from msgs_spec.codecs import decode
from msgs_spec.schemas import deserialize, type_hash
from msgs_spec.text import one_line
from msgs_spec.tick import EpisodeStatus, Tick, TickEncoder
from msgs_spec.topics import TopicSpec

# Characters of a value in a line.
_LONGEST = 80
# Keys of the record `episode` that name software; another value is a change, not a difference.
_SOFTWARE = ('interface_version', 'model_sha256', 'source_revision')
_COMMANDS = {'commands', 'joint_commands'}
# Keys of the record `episode_result` that do not follow from the simulation.
_NOT_SIMULATED = {'reason', 'received_not_logged', 'late_commands'}


@dataclass(frozen=True, slots=True)
class Difference:
    """A difference between a recorded episode and the same episode simulated again.

    Attributes:
        tick: Number of the tick, 0 for the reset.
        stamp_ns: Recorded stamp of the tick.
        field: Topic and field of the message, or another part of the file such as `metadata seed`.
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


def _short(text: str) -> str:
    """Shorten a hash or version to 12 characters; keep the suffix `-dirty` of a revision."""
    return text[:12] + ('-dirty' if text.endswith('-dirty') else '')


def _difference(
    tick: int, stamp_ns: int, field: str, recorded: object, simulated: object
) -> Difference:
    given, expected = (one_line(value, longest=_LONGEST) for value in (recorded, simulated))
    return Difference(tick, stamp_ns, one_line(field), given, expected)


@dataclass(slots=True)
class CheckResult:
    """Result of the check of one episode.

    Attributes:
        path: The MCAP file.
        ticks: Number of identical ticks, up to the first difference.
        messages: Number of messages that the robot published in these ticks.
        unchecked: Number of messages in a last tick without `applied_command`; not checked.
        difference: The first difference; None if the episode is identical.
        changed: Software versions that differ from the recorded ones: `name recorded -> here`.
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


@lru_cache(maxsize=1)
def _reference(task: str, **rules: Any) -> tuple[Simulation, RecordingContext, str]:
    """Return (simulation, recording context, old model hash) to compare an episode with.

    The context creates metadata of a recording made now. The hash is the one that files of version
    1.0 contain. `rules` are arguments of `Simulation`. The last result is cached.
    """
    simulation = Simulation(task, num_threads=1, **rules)
    context = RecordingContext(simulation, with_compiled_model=False)
    return simulation, context, former_model_sha256(simulation.model)


def check_episode(path: Path) -> CheckResult:
    """Simulate an episode again and compare it; `path` is a bag directory or MCAP file.

    Raises:
        EpisodeReadError: If the file is invalid, or lacks data to simulate the episode again.
    """
    episode = read_episode(path)
    ticks = split_ticks(episode)
    result = CheckResult(episode.path)
    try:
        record = EpisodeRecord.parse(episode.metadata)
        _require_goals(episode)
        simulation, context, former = _reference(
            record.task.name,
            reward_type=record.reward_type,
            success_rule=record.success_rule,
            control_hz=record.control_hz,
            timing=record.timing,
            disturbances=record.disturbances,
        )
        runner = EpisodeRunner(
            simulation,
            first_seed=record.seed - record.episode,
            first_episode=record.episode,
            first_stamp_ns=ticks[0].stamp_ns,
            joint_prefix=record.joint_prefix,
        )
        off = record.disturbances.is_off
        disturbances = '' if off else record.disturbances.to_json()
        status = dataclasses.replace(runner.waiting_status(), disturbances=disturbances)
        here = context.metadata(status)
        del here['started']
        if episode.metadata.get('model_sha256') == former:
            here['model_sha256'] = former
        mjcf = context.attachments[0].data
        differences = chain(
            _start_differences(episode, ticks[0].stamp_ns, here, mjcf, result),
            _topic_differences(episode, ticks),
            _differences(runner, ticks, episode, record, result),
        )
        result.difference = next(differences, None)
    except (ValueError, KeyError, OverflowError, RuntimeError) as error:
        raise EpisodeReadError(
            f'{episode.path}: cannot be simulated again ({one_line(error)})'
        ) from error
    return result


def _start_differences(
    episode: Episode, stamp_ns: int, here: dict[str, str], mjcf: bytes, result: CheckResult
) -> Iterator[Difference]:
    """Compare the recorded metadata and MJCF text with `here` and `mjcf`; yield the differences.

    `here` is the metadata of a recording made now, `mjcf` its MJCF text. Other software versions
    are no differences; they are added to `result.changed`.
    """
    recorded = episode.metadata
    for name, value in here.items():
        is_software = name in _SOFTWARE or name.endswith('_version')
        given = recorded.get(name, value if is_software else 'nothing')
        if given != value and is_software:
            changed = f'{_short(one_line(given))} -> {_short(value)}'
            result.changed.append(f'{name.removesuffix("_version")} {changed}')
        elif given != value:
            yield _difference(0, stamp_ns, f'metadata {name}', given, value)
    model = episode.attachments.get('model.xml')
    is_same = all(recorded.get(n, here[n]) == here[n] for n in ('model_sha256', 'mujoco_version'))
    if model is not None and is_same and model != mjcf:
        yield _difference(0, stamp_ns, 'attachment model.xml', 'another text', 'the model')


def _topic_differences(episode: Episode, ticks: list[LoggedTick]) -> Iterator[Difference]:
    """Yield wrong type hashes, QoS profiles, publish times and sequence numbers of messages.

    Publish times must equal log times; sequence numbers must count up from 0.
    """
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


def _differences(
    runner: EpisodeRunner,
    ticks: list[LoggedTick],
    episode: Episode,
    record: EpisodeRecord,
    result: CheckResult,
) -> Iterator[Difference]:
    """Simulate the episode, yield differences, and count identical ticks in `result`."""
    encoder = TickEncoder(runner.spec)
    is_recovered = episode.outcome.reason == RECOVERED
    received = _Received(runner, episode, record)
    for number, logged in enumerate(ticks):
        differs = partial(_difference, number, logged.stamp_ns)
        command = _applied_command(logged) if number else runner.resting_command()
        if command is None:
            if logged is not ticks[-1]:
                raise ValueError(f'no applied_command at tick {number}')
            result.unchecked = len(logged.published)
            if episode.is_complete:
                yield differs('topic', 'no applied_command', 'applied_command')
            return
        if number and runner.is_between_episodes:
            yield differs('length', f'{len(ticks)} ticks', f'{number} ticks')
        tick = runner.advance(command)
        drawn = episode.metadata.get('variation', '')
        if drawn != tick.status.variation:
            yield differs('metadata variation', drawn, tick.status.variation)
        tick = _as_of(record.interface_version, tick)
        has_status = logged.find('episode_status') is not None
        encoded = encoder.encode(tick, latched=has_status or tick.status.phase != 'running')
        expected = [each for each in encoded if each[0].since <= record.interface_version]
        if logged is ticks[-1] and not runner.is_between_episodes:
            expected = expected[: len(logged.published)]
        # Recovery may leave out received messages.
        others = [] if is_recovered else logged.received
        for difference in chain(
            received.differences(number, command),
            _tick_differences(logged, others, tick.stamp_ns, expected),
        ):
            yield differs(*difference)
        result.ticks += 1
        result.messages += len(logged.published)
        received.take(logged)
    yield from _result_differences(ticks[-1], tick.status, runner, episode)


def _require_goals(episode: Episode) -> None:
    """Raise `ValueError` if, by its metadata, the file lacks goals or pushes sent to the robot."""
    for name in ('set_goal', 'perturb'):
        if name in episode.outcome.received_not_logged:
            raise ValueError(f'the file lacks some of the received messages of {name}')


def _as_of(interface_version: int, tick: Tick) -> Tick:
    """Return `tick` as a robot with this interface version publishes it.

    In version 1 all orientations in `fingertip_poses` were the identity; later ones keep `tick`.
    """
    if interface_version != 1 or 'fingertip_poses' not in tick.readings:
        return tick
    poses = tick.readings['fingertip_poses'].reshape(-1, 7).copy()
    poses[:, 3:] = [1.0, 0.0, 0.0, 0.0]
    return dataclasses.replace(tick, readings={**tick.readings, 'fingertip_poses': poses.ravel()})


def _result_differences(
    last: LoggedTick, status: EpisodeStatus, runner: EpisodeRunner, episode: Episode
) -> Iterator[Difference]:
    """Yield differences between the record `episode_result` and `status`, the simulated end."""
    # An interrupted recording can contain all ticks and no end of the episode.
    is_whole = runner.is_between_episodes and episode.result.get('complete') != 'false'
    expected = {**episode_result(status), 'complete': 'true' if is_whole else 'false'}
    # A file that was cut short may lack all but `complete`.
    missing = {'complete': 'nothing'}
    for name in sorted({*expected, *episode.result.keys() - _NOT_SIMULATED}):
        simulated = expected.get(name, 'nothing')
        recorded = episode.result.get(name, missing.get(name, simulated))
        if recorded != simulated:
            where = f'episode_result {one_line(name, longest=40)}'
            yield _difference(status.tick, last.stamp_ns, where, recorded, simulated)


def _applied_command(logged: LoggedTick) -> Array | None:
    message = logged.find('applied_command')
    if message is None:
        return None
    return decode(message.topic, deserialize(message.topic.type_name, message.data))


class _Received:
    """Applies the logged received messages (commands, goals, pushes) as `sim_node` does."""

    def __init__(self, runner: EpisodeRunner, episode: Episode, record: EpisodeRecord) -> None:
        self._runner = runner
        self._record = record
        self._commands = CommandBuffer(runner.spec.robot, timeout=0.0)
        outcome = episode.outcome
        is_recovered = outcome.reason == RECOVERED
        self._lacks_commands = is_recovered or bool(_COMMANDS & outcome.received_not_logged.keys())

    def differences(self, number: int, command: Array) -> Iterator[tuple[str, object, object]]:
        """Yield (field, applied, received) if the robot applied another command than it received.

        `command` was applied at tick `number`. Yield nothing if the file has no newer command.
        """
        if not number:
            self._commands.start_episode(self._runner.resting_command())
        if not self._lacks_commands and self._commands.has_fresh_command:
            received = self._commands.take()
            if not np.array_equal(command, received):
                yield 'applied_command', command, f'{received} received'

    def take(self, logged: LoggedTick) -> None:
        """Apply the messages that the robot received between the tick `logged` and the next."""
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


def _tick_differences(
    logged: LoggedTick,
    received: list[TickMessage],
    stamp_ns: int,
    expected: list[tuple[TopicSpec, bytes]],
) -> Iterator[tuple[str, object, object]]:
    """Yield (field, recorded value, simulated value) for differences in the messages of a tick.

    `expected` are the simulated published messages; `received` are logged messages from other
    nodes. Log times of all messages count up from `stamp_ns`.
    """
    names = [message.topic.name for message in logged.published]
    wanted = [topic.name for topic, _ in expected]
    for index, (name, other) in enumerate(zip_longest(names, wanted, fillvalue='nothing')):
        if name != other:
            yield f'topic of message {index}', name, other
            break
    for message, (topic, data) in zip(logged.published, expected, strict=False):
        if message.data != data:
            where, recorded, simulated = _field_difference(topic, message.data, data)
            yield f'{topic.name}{where}', recorded, simulated
    for time_ns, message in enumerate([*logged.published, *received], start=stamp_ns):
        if message.log_time_ns != time_ns:
            yield f'log time of {message.topic.name}', message.log_time_ns, time_ns


def _field_difference(topic: TopicSpec, recorded: bytes, simulated: bytes) -> tuple[str, str, str]:
    """Return (field, recorded, simulated) where they first differ; field '' if only bytes do."""
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
        # Numbers of NumPy would be shown as `np.float64(0.5)`.
        elements = value.tolist() if isinstance(value, np.ndarray) else value
        for index, element in enumerate(elements):
            yield from _leaves(element, f'{where}[{index}]')
    else:
        yield where, value
