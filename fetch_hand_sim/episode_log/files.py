"""Find the files of episodes; create, lock and rename them.

An episode is written into the hidden directory `.<name>.active`. This directory is renamed to
`<name>` when the episode is complete. Recovery moves files without messages to `.<name>.aside`.
"""

from __future__ import annotations

import errno
import fcntl
import os
import shlex
import stat
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from typing import IO, BinaryIO, TypeVar

from msgs_spec.text import first_of, printable

Read = TypeVar('Read')

# Characters of an error: the path at its beginning and the reason at its end are kept.
_LONGEST, _BEGINNING = 1000, 700


class _OneLineError(Exception):
    """An error with a message of one line, of limited length, that no terminal obeys."""

    def __init__(self, message: str) -> None:
        if len(message) > _LONGEST:
            message = f'{message[:_BEGINNING]} ... {message[_BEGINNING - _LONGEST :]}'
        super().__init__(printable(message))


class EpisodeLogError(_OneLineError, RuntimeError):
    """An episode cannot be written or recovered; the message is one line with path and reason."""


class EpisodeExistsError(EpisodeLogError):
    """The name belongs to an existing episode: finished, being written or cut off."""


class EpisodeInUseError(EpisodeLogError):
    """Another process writes or recovers the episode, or has just completed it."""


class EpisodeReadError(_OneLineError, ValueError):
    """A file is not a valid episode; the message is one line with path and reason."""


_PREFIX, _SUFFIX, _ASIDE = '.', '.active', '.aside'
_MIB = 1024 * 1024
# Number of folders that an error lists.
_LISTED = 3


# Names


def active_path(directory: Path, name: str) -> Path:
    """Return the hidden directory in which the episode `name` is written."""
    return directory / f'{_PREFIX}{name}{_SUFFIX}'


def aside_path(directory: Path, name: str) -> Path:
    """Return the hidden directory for files of the episode `name` that recovery cannot use."""
    return directory / f'{_PREFIX}{name}{_ASIDE}'


def active_name(path: Path) -> str | None:
    """Return the name of the episode whose hidden directory is `path`; None for other paths."""
    if path.name.startswith(_PREFIX) and path.name.endswith(_SUFFIX):
        return path.name[len(_PREFIX) : -len(_SUFFIX)]
    return None


def bag_file(directory: Path, name: str) -> Path:
    """Return the MCAP file of the episode `name` in its own directory, final or hidden."""
    return directory / f'{name}_0.mcap'


def rewritten_file(file: Path) -> Path:
    """Return the temporary file that recovery writes and then renames to `file`."""
    return file.with_suffix('.recovered')


def metadata_file(directory: Path) -> Path:
    """Return the path of rosbag2's `metadata.yaml` in a bag directory."""
    return directory / 'metadata.yaml'


def is_mcap(path: Path) -> bool:
    """Return whether a path ends in `.mcap` and is not a `._` file of macOS."""
    return path.suffix == '.mcap' and not path.name.startswith('._')


# Finding


def find_episodes(directory: Path | str) -> list[Path]:
    """Return the paths of the bag directories and MCAP files in a directory, sorted by name.

    Directories `.<name>.active` and `.<name>.aside` are left out; see `find_leftovers`. An
    unreadable directory raises EpisodeReadError.
    """
    try:
        entries = sorted(Path(directory).iterdir())
        return [path for path in entries if _is_bag(path)]
    except OSError as error:
        raise EpisodeReadError(f'{error.filename or directory}: {error.strerror}') from error


def _is_bag(path: Path) -> bool:
    if path.name.startswith(_PREFIX) and path.name.endswith((_SUFFIX, _ASIDE)):
        return False
    try:
        if path.is_dir():
            return metadata_file(path).exists() or any(map(is_mcap, path.glob('*.mcap')))
    except OSError:
        return True  # Reading it will report why it cannot be read.
    return is_mcap(path)


def folders_below(directory: Path) -> str:
    """Return up to 3 subfolders with episodes, as the text `a, b, c and 2 more`; '' if none."""
    try:
        folders = [path for path in sorted(directory.iterdir()) if path.is_dir()]
        held = [path for path in folders if path.name[0] != '.' and find_episodes(path)]
    except (OSError, EpisodeReadError):
        return ''
    return first_of([printable(str(path)) for path in held], _LISTED)


def _hint(directory: Path) -> str:
    """Return a text that starts with `; ` and names other episodes of a folder; '' if none."""
    if below := folders_below(directory):
        return f'; there are some in {below}'
    with suppress(OSError):
        if any(map(active_name, directory.iterdir())):
            folder = shlex.quote(str(directory))
            return (
                f'; some are unfinished: `fetch_hand_sim episodes recover {folder}` completes '
                'those that no process writes'
            )
    return ''


def holds_no_episode(directory: Path) -> EpisodeReadError:
    """Return an error for a folder without episodes; it names subfolders and unfinished ones."""
    return EpisodeReadError(f'{directory} holds no episode{_hint(directory)}')


def expand_episodes(path: Path | str) -> list[Path]:
    """Return the episodes in the directory `path`, or [`path`] if it is itself a bag or a file.

    A missing or unreadable path raises EpisodeReadError.
    """
    path = Path(path)
    try:
        if not path.exists():
            raise EpisodeReadError(f'{path}: No such file or directory')
        if not path.is_dir() or metadata_file(path).exists():
            return [path]
    except OSError as error:
        raise EpisodeReadError(f'{path}: {error.strerror}') from error
    return find_episodes(path)


def read_each(
    paths: Iterable[Path],
    read: Callable[[Path], Read],
    on_skip: Callable[[EpisodeReadError], object] | None = None,
) -> Iterator[Read]:
    """Yield `read(path)` of each path; pass EpisodeReadError to `on_skip` if given, or raise it."""
    for path in paths:
        try:
            result = read(path)
        except EpisodeReadError as error:
            if on_skip is None:
                raise
            on_skip(error)
        else:
            yield result


def mcap_file(path: Path) -> Path:
    """Return the MCAP file in a bag directory; a path to a file is returned unchanged.

    A directory without exactly one MCAP file raises EpisodeReadError.
    """
    try:
        if not path.is_dir():
            if path.exists() and not path.is_file():
                raise EpisodeReadError(f'{path} is no regular file')  # A pipe would never end.
            return path
        # `glob` finds nothing in a directory without permission.
        found = sorted(file for file in path.iterdir() if is_mcap(file) and file.is_file())
    except OSError as error:
        raise EpisodeReadError(f'{path}: {error.strerror}') from error
    if len(found) != 1:
        raise EpisodeReadError(
            f'{path} holds {len(found)} MCAP files; an episode is a directory of one{_hint(path)}'
        )
    return found[0]


# Writing


def claim(directory: Path, name: str) -> BufferedWriter:
    """Create the hidden directory of an episode and its locked, empty MCAP file.

    Raises:
        EpisodeExistsError: If an episode of this name is finished, being written or cut off. If
            several processes try at the same time, one succeeds.
        OSError: If the directory or file cannot be created.
    """
    active = active_path(directory, name)
    try:
        active.mkdir()
    except FileExistsError:
        raise EpisodeExistsError(
            f'{active} exists: {name} is being written or was cut off'
        ) from None
    try:
        # Checked after the claim: only the process with the claim may finish under this name.
        if (directory / name).exists():
            raise EpisodeExistsError(f'{directory / name} exists; episodes are never overwritten')
        stream = bag_file(active, name).open('xb')
    except FileNotFoundError:
        raise EpisodeExistsError(f'{active} was cleared away as the rest of a kill') from None
    except (OSError, EpisodeExistsError):
        active.rmdir()
        raise
    lock(stream)
    if os.fstat(stream.fileno()).st_nlink == 0:
        stream.close()
        raise EpisodeExistsError(f'{active} was cleared away as the rest of a kill')
    return stream


def require_free_space(directory: Path, minimum_bytes: int) -> None:
    """Raise `OSError` if the disk of `directory` has less than `minimum_bytes` free."""
    status = os.statvfs(directory)
    if status.f_bavail * status.f_frsize < minimum_bytes:
        raise OSError(errno.ENOSPC, f'less than {minimum_bytes / _MIB:g} MiB free on the disk')


def lock(stream: IO[bytes]) -> None:
    """Lock a file for writing until it is closed; wait while another process holds a lock."""
    # File systems without locks only lose the distinction between running and cut-off episodes.
    with suppress(OSError):
        fcntl.flock(stream, fcntl.LOCK_EX)


def try_lock(stream: IO[bytes], shared: bool = False) -> bool:
    """Lock a file, for reading if `shared`; return False at once if another lock prevents it."""
    try:
        fcntl.flock(stream, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # No locks on this file system, see `lock`.
    return True


def open_regular(path: Path) -> BinaryIO:
    """Open a regular file for reading; raise OSError for links, pipes and other kinds."""
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError(errno.EINVAL, 'is no regular file', str(path))
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags), 'rb')


def create(path: Path) -> BinaryIO:
    """Create a file for writing; remove an existing file or link of this name first."""
    path.unlink(missing_ok=True)
    return path.open('xb')


def is_locked(path: Path) -> bool:
    """Return whether a process holds the write lock of a file; OSError if it is not regular."""
    with open_regular(path) as stream:
        return not try_lock(stream, shared=True)


def sync_directory(path: Path) -> None:
    """Flush the entries of a directory to the disk (fsync)."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def store(stream: IO[bytes], directory: Path, description: str) -> None:
    """Write `directory`/metadata.yaml with `description`; fsync it and the MCAP file `stream`."""
    stream.flush()
    os.fsync(stream.fileno())
    with create(metadata_file(directory)) as text:
        text.write(description.encode())
        text.flush()
        os.fsync(text.fileno())


def publish(active: Path, final: Path) -> None:
    """Rename the hidden directory `active` of a complete episode to `final`, atomically."""
    sync_directory(active)
    active.rename(final)
    sync_directory(final.parent)
