"""Find episodes that a killed process or a full disk cut off, and make valid bags of them.

The hidden directory `.<name>.active` of a cut-off episode is a leftover. It is only reported, not
recovered, if it contains links or files that this package does not write.
"""

from __future__ import annotations

import errno
import os
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode

from fetch_hand_sim.episode_log import files
from fetch_hand_sim.episode_log.bag import (
    EPISODE,
    EPISODE_RESULT,
    Attachment,
    BagFile,
    checked_strings,
)
from fetch_hand_sim.episode_log.files import EpisodeInUseError, EpisodeLogError
from fetch_hand_sim.episode_log.indexes import require_one_meaning
from fetch_hand_sim.episode_log.metadata import RECOVERED, EpisodeOutcome, parse_task
from fetch_hand_sim.episode_log.reader import contract_topics, read_episode, require_contract
from fetch_hand_sim.episode_log.records import (
    MAX_FILE_BYTES,
    Contents,
    split_records,
)
from fetch_hand_sim.episode_log.writer import ReceivedAllowance
from msgs_spec.codecs import TopicCodec
from msgs_spec.text import one_line, printable
from msgs_spec.topics import TopicSpec, relative_name

# Bytes that may be lost without a copy: part of a record, but no message with a tick of data.
_FEW_BYTES = 64
_COUNTED = ('reward', 'is_success', 'applied_command')


@dataclass(frozen=True, slots=True)
class Leftover:
    """An unfinished episode that no process is writing.

    Attributes:
        path: Hidden directory of the episode.
        size_bytes: Total size of its files; 0 with a `problem`.
        age_s: Seconds since the last write; 0 with a `problem`.
        problem: Why recovery rejects the path: it is unreadable, is no directory, or contains
            entries that this package does not write; '' otherwise.
    """

    name: str
    path: Path
    size_bytes: int
    age_s: float
    problem: str = ''

    def __str__(self) -> str:
        if self.problem:
            return printable(f'no episode of a robot: {self.problem}')
        return printable(
            f'unfinished episode {self.name}: {self.size_bytes / 1024:.0f} KiB in {self.path}, '
            f'last written {self.age_s:.0f} s ago'
        )


def find_leftovers(directory: Path | str) -> list[Leftover]:
    """Return the unfinished episodes in a directory, sorted by name.

    Episodes that a process is writing are left out. The result is empty for a missing directory; an
    unreadable one raises EpisodeLogError.
    """
    try:
        found = [_inspect(path) for path in sorted(Path(directory).iterdir())]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise EpisodeLogError(
            f'cannot read episodes: {error.filename}: {error.strerror}'
        ) from error
    return [leftover for leftover in found if leftover is not None]


def _inspect(path: Path) -> Leftover | None:
    """Return the leftover at `path`; None if it is in use, gone, or not named `.<name>.active`."""
    name = files.active_name(path)
    if name is None:
        return None
    try:
        found = _entries(path, name)
        if any(files.is_locked(file) for file in found):
            return None
        statuses = [file.lstat() for file in found]
        written = max(status.st_mtime for status in statuses or [path.lstat()])
    except FileNotFoundError:
        return None
    except OSError as error:
        problem = f'{error.filename or path}: {error.strerror}'
        return Leftover(name, path, size_bytes=0, age_s=0.0, problem=problem)
    size = sum(status.st_size for status in statuses)
    return Leftover(name, path, size, age_s=max(0.0, time.time() - written))


def _entries(path: Path, name: str) -> list[Path]:
    """Return the files of a leftover; OSError if it is no directory or has unknown entries."""
    if not stat.S_ISDIR(path.lstat().st_mode):
        raise NotADirectoryError(errno.ENOTDIR, 'is no directory', str(path))
    file = files.bag_file(path, name)
    known = {file, files.rewritten_file(file), files.metadata_file(path)}
    found = sorted(path.iterdir())
    for entry in found:
        if entry not in known:
            raise OSError(errno.EINVAL, 'is not of an episode', str(entry))
        if not stat.S_ISREG(entry.lstat().st_mode):
            raise OSError(errno.EINVAL, 'is no regular file', str(entry))
    return found


def recover_episode(leftover: Path | str) -> Path | None:
    """Make a valid bag of the episode in the hidden directory `leftover`; return the bag's path.

    The bag contains all complete chunks; at most the last quarter of a second is missing. The new
    file is read back before it replaces the cut-off file. If more than 64 bytes of the cut-off
    file are unreadable, a copy of it is kept in `.<name>.aside`.

    Without readable messages, return None and move the hidden directory to `.<name>.aside`. If the
    file contains at most 64 bytes after the header, remove the directory instead.

    Raises:
        EpisodeInUseError: If another process writes, recovers or has recovered the episode.
        EpisodeLogError: If the file is ambiguous (such as two episodes), is not of this package, a
            finished episode has its name, or the disk fails. The episode stays unfinished then.
    """
    leftover = Path(leftover)
    name = files.active_name(leftover)
    if name is None:
        raise EpisodeLogError(f'{leftover} is no unfinished episode')
    found = _inspect(leftover)
    if found is None:
        raise _in_use(leftover)
    if found.problem:
        raise EpisodeLogError(f'cannot recover episode {leftover}: {found.problem}')
    try:
        return _recover(leftover, name)
    except EpisodeLogError:
        raise
    except FileNotFoundError:
        raise _in_use(leftover) from None
    except OSError as error:
        reason = error.strerror or error
        raise EpisodeLogError(f'cannot recover episode {leftover}: {reason}') from error
    except Exception as error:  # One bad leftover must not stop the recovery of the others.
        raise EpisodeLogError(f'cannot recover episode {leftover}: {one_line(error)}') from error


def _in_use(leftover: Path) -> EpisodeInUseError:
    return EpisodeInUseError(f'{leftover} is being written, or another process has recovered it')


def _recover(leftover: Path, name: str) -> Path | None:
    file, final = files.bag_file(leftover, name), leftover.parent / name
    if not file.exists():
        entries = [files.rewritten_file(file), files.metadata_file(leftover)]
        if any(entry.exists() and entry.stat().st_size > _FEW_BYTES for entry in entries):
            leftover.rename(files.aside_path(leftover.parent, name))
            return None
        # A robot may begin its file right now, so its new file and the folder stay.
        _remove(leftover, entries)
        return None
    with files.open_regular(file) as torn:
        # The process that recovers it locks the file and its replacement.
        if not files.try_lock(torn) or not os.fstat(torn.fileno()).st_nlink:
            raise _in_use(leftover)
        remains = _read(torn)
        if not remains.contents.message_count:
            if not remains.is_empty:
                leftover.rename(files.aside_path(leftover.parent, name))
                return None
            _remove(leftover, list(leftover.iterdir()))
            return None
        if final.exists():
            raise EpisodeLogError(
                f'{final} exists and is never overwritten; if {leftover.name} is an older copy of '
                'it, remove that'
            )
        with _replaced(file, remains, files.aside_path(leftover.parent, name)):
            files.publish(leftover, final)
    return final


def _remove(leftover: Path, entries: list[Path]) -> None:
    for entry in entries:
        entry.unlink(missing_ok=True)
    try:
        leftover.rmdir()
    except OSError as error:
        if error.errno in (errno.ENOTEMPTY, errno.EEXIST):
            raise _in_use(leftover) from None
        raise


@dataclass(slots=True)
class _Remains:
    """The readable part of a cut-off file.

    Attributes:
        contents: Records before the first damaged one.
        is_whole: Whether reading reached the footer, which only a complete file has.
        is_empty: Whether the file contains at most 64 bytes after the header.
        damage: Description of the damage at which reading stopped; '' without damage.
        unread_bytes: Bytes from the damage to the end of the file.
    """

    contents: Contents
    is_whole: bool = False
    is_empty: bool = False
    damage: str = ''
    unread_bytes: int = 0


def _read(stream: BinaryIO) -> _Remains:
    data = stream.read(MAX_FILE_BYTES + 1)
    if len(data) > MAX_FILE_BYTES:
        raise ValueError(f'a file of more than {MAX_FILE_BYTES} bytes')
    remains = _Remains(Contents())
    header_end = read = 0
    is_data = True
    try:
        for opcode, position, end in split_records(data):
            if opcode == Opcode.FOOTER:
                remains.is_whole = True
                read = len(data)
                break
            is_data = is_data and opcode != Opcode.DATA_END
            if is_data and opcode != Opcode.HEADER:
                remains.contents.take(opcode, data, position, end)
            header_end = header_end or end
            read = end
    except ValueError as error:
        remains.damage = one_line(error)
    remains.unread_bytes = len(data) - read
    remains.is_empty = len(data) - header_end <= _FEW_BYTES
    return remains


@contextmanager
def _replaced(file: Path, remains: _Remains, aside: Path) -> Iterator[None]:
    """Replace a cut-off file by a valid one, run the block, then unlock the valid file.

    The cut-off file is copied into the folder `aside` if more than 64 bytes of it are unreadable.
    """
    contents = remains.contents
    records = {record.name: record.content for record in contents.metadata}
    if EPISODE not in records:
        raise EpisodeLogError(
            f'{file} has no metadata record {EPISODE!r}: nothing to recover ({remains.damage})'
        )
    require_one_meaning(contents)
    require_contract(records[EPISODE], contents)
    rewritten = files.rewritten_file(file)
    try:
        with files.create(rewritten) as stream:
            files.lock(stream)
            description = _write(stream, file, remains, records)
            files.store(stream, file.parent, description)
            read_episode(rewritten)
            if remains.unread_bytes > _FEW_BYTES:
                aside.mkdir(exist_ok=True)
                shutil.copyfile(file, aside / file.name)
            rewritten.replace(file)
            yield
    finally:
        rewritten.unlink(missing_ok=True)


def _write(
    stream: BinaryIO, file: Path, remains: _Remains, records: dict[str, dict[str, str]]
) -> str:
    """Write the readable records to `stream` as a valid bag; return the text of `metadata.yaml`.

    The text contains the name of `file`. `records` has the contents of metadata records by name.
    """
    contents, metadata = remains.contents, checked_strings(records[EPISODE])
    messages = contents.messages()
    specs = contract_topics(parse_task(metadata))
    known = {
        id: (channel.topic, specs[relative_name(channel.topic)])
        for id, channel in contents.channels.items()
    }
    result = records.get(EPISODE_RESULT) if remains.is_whole else None
    attachments = [Attachment(a.name, a.media_type, a.data) for a in contents.attachments]
    bag = BagFile(stream, file.name, metadata, attachments)
    received = ReceivedAllowance()
    values: dict[str, list[bytes]] = {name: [] for name in _COUNTED}
    for id, _, log_time, _, data in messages.rows():
        name, topic = known[id]
        if topic.direction == 'published' or received.accepts(topic.name, len(data)):
            bag.write(name, topic, data, log_time)
        if topic.name in values:
            values[topic.name].append(data)
    return bag.finish(checked_strings(result or _outcome(values, specs).to_strings()))


def _outcome(values: dict[str, list[bytes]], specs: dict[str, TopicSpec]) -> EpisodeOutcome:
    """Return steps, return and success at the last whole tick, computed from the messages.

    `values` has the CDR messages on `reward`, `is_success` and `applied_command`, in this order.
    The three results are None if messages are missing or invalid. `specs` has the topics by name.
    """
    cut_off = EpisodeOutcome(is_complete=False, reason=RECOVERED)
    rewards, successes, commands = values.values()
    # `applied_command` comes last among the topics with a message per tick.
    steps = len(commands)
    if len(rewards) < steps or len(successes) <= steps:
        return cut_off
    decode = TopicCodec(specs['reward']).decode
    try:
        total = float(sum(float(decode(data)[1][0]) for data in rewards[:steps]))
        is_success = bool(TopicCodec(specs['is_success']).decode(successes[steps])[1][0])
    except ValueError:
        return cut_off
    return replace(cut_off, steps=steps, episode_return=total, is_success=is_success)
