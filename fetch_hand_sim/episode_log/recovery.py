"""Makes a valid bag of a cut-off episode: what reached the disk, marked as interrupted."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import yaml
from mcap import records

from fetch_hand_sim.episode_log import durable
from fetch_hand_sim.episode_log.bag_file import ChannelSpec
from fetch_hand_sim.episode_log.episode_bag import EPISODE, EPISODE_RESULT, begin_bag, complete_bag
from fetch_hand_sim.episode_log.errors import EpisodeLogError
from fetch_hand_sim.episode_log.reader import DAMAGED, one_line, read_episode
from fetch_hand_sim.episode_log.settings import Attachment, LogSettings
from fetch_hand_sim.episode_log.untrusted import read_records
from msgs_spec.schemas import deserialize


@dataclass(slots=True)
class _Remains:
    """What can be read of a file, up to the first damage."""

    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    schemas: dict[int, records.Schema] = field(default_factory=dict)
    channels: dict[int, records.Channel] = field(default_factory=dict)
    messages: list[records.Message] = field(default_factory=list)
    is_whole: bool = False

    @property
    def result(self) -> dict[str, str]:
        """How the episode ended; only a file that is whole knows."""
        if self.is_whole and EPISODE_RESULT in self.metadata:
            return self.metadata[EPISODE_RESULT]
        return {**self._outcome(), 'complete': 'false', 'reason': 'cut off, recovered later'}

    def _outcome(self) -> dict[str, str]:
        """Steps, return and success up to the last whole tick."""
        # Of the topics with a number per tick, `applied_command` comes last.
        steps = len(self._values('applied_command'))
        rewards, successes = self._values('reward'), self._values('is_success')
        if len(rewards) < steps or len(successes) <= steps:
            return {}
        return {
            'steps': str(steps),
            'return': repr(float(sum(rewards[:steps]))),
            'success': str(bool(successes[steps])).lower(),
        }

    def _values(self, name: str) -> list[Any]:
        """The `data` of all messages of a topic of std_msgs."""
        types = {
            id: self.schemas[channel.schema_id].name
            for id, channel in self.channels.items()
            if channel.topic.rpartition('/')[2] == name
        }
        found = [m for m in self.messages if m.channel_id in types]
        try:
            return [deserialize(types[m.channel_id], m.data).data for m in found]
        except ValueError:
            return []


def recover_episode(leftover: Path) -> Path:
    """Completes an episode that a crash cut off.

    All whole chunks become a bag under the name of the episode; at most the last quarter second of
    simulated time is missing. The torn file is replaced when the new one has been read back.

    Args:
        leftover: Hidden directory of the episode, see `find_leftovers`.

    Returns:
        The bag directory.

    Raises:
        EpisodeLogError: If it is being written, holds nothing, or the disk refuses.
    """
    name = durable.active_name(leftover)
    if name is None:
        raise EpisodeLogError(f'{leftover} is no unfinished episode')
    file = durable.bag_file(leftover, name)
    final = leftover.parent / name
    try:
        if final.exists():
            raise EpisodeLogError(f'{final} exists; episodes are never overwritten')
        with file.open('rb') as torn:
            if not durable.try_lock(torn):
                raise EpisodeLogError(f'{leftover} is being written')
            _replace(file, _read(torn))
            durable.publish(leftover, final)
    except EpisodeLogError:
        raise
    except OSError as error:
        reason = error.strerror or error
        raise EpisodeLogError(f'cannot recover episode {leftover}: {reason}') from error
    except (*DAMAGED, yaml.YAMLError) as error:
        raise EpisodeLogError(f'cannot recover episode {leftover}: {one_line(error)}') from error
    return final


def _read(stream: BinaryIO) -> _Remains:
    remains = _Remains()
    with suppress(*DAMAGED):
        for record in read_records(stream):
            match record:
                case records.Message():
                    remains.messages.append(record)
                case records.Channel():
                    remains.channels[record.id] = record
                case records.Schema():
                    remains.schemas[record.id] = record
                case records.Attachment():
                    remains.attachments.append(
                        Attachment(record.name, record.media_type, record.data)
                    )
                case records.Metadata():
                    remains.metadata[record.name] = dict(record.metadata)
                case records.Footer():
                    remains.is_whole = True
    return remains


def _replace(file: Path, remains: _Remains) -> None:
    if not remains.messages or EPISODE not in remains.metadata:
        raise EpisodeLogError(f'{file} holds no whole chunk of messages: nothing to recover')
    rewritten = file.with_suffix('.recovered')
    try:
        with rewritten.open('wb') as stream:
            _write(stream, file, remains)
        read_episode(rewritten)
        rewritten.replace(file)
    finally:
        rewritten.unlink(missing_ok=True)


def _write(stream: BinaryIO, file: Path, remains: _Remains) -> None:
    metadata = remains.metadata[EPISODE]
    bag = begin_bag(stream, file.name, LogSettings(), metadata, remains.attachments)
    specs = {id: _channel_spec(remains, channel) for id, channel in remains.channels.items()}
    for message in remains.messages:
        bag.write(specs[message.channel_id], message.data, message.log_time)
    complete_bag(bag, stream, file.parent, metadata, remains.result)


def _channel_spec(remains: _Remains, channel: records.Channel) -> ChannelSpec:
    schema = remains.schemas[channel.schema_id]
    return ChannelSpec(
        topic=channel.topic,
        type_name=schema.name,
        schema_text=schema.data.decode(),
        qos_yaml=channel.metadata['offered_qos_profiles'],
        type_hash=channel.metadata['topic_type_hash'],
    )
