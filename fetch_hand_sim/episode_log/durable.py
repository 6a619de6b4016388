"""File system steps of an episode: claimed under a hidden name, shown when complete."""

from __future__ import annotations

import errno
import fcntl
import os
import stat
from contextlib import suppress
from io import BufferedWriter
from pathlib import Path
from typing import IO, BinaryIO

from fetch_hand_sim.episode_log.errors import EpisodeExistsError

_PREFIX, _SUFFIX = '.', '.active'
_MIB = 1024 * 1024


def active_path(directory: Path, name: str) -> Path:
    """Returns the directory in which the episode `name` is written."""
    return directory / f'{_PREFIX}{name}{_SUFFIX}'


def active_name(path: Path) -> str | None:
    """Returns the name of the episode that is written in `path`, None for other directories."""
    if path.name.startswith(_PREFIX) and path.name.endswith(_SUFFIX):
        return path.name[len(_PREFIX) : -len(_SUFFIX)]
    return None


def bag_file(directory: Path, name: str) -> Path:
    """Returns the MCAP file of the episode `name` in its directory, hidden or not."""
    return directory / f'{name}_0.mcap'


def rewritten_file(file: Path) -> Path:
    """Returns where recovery writes the MCAP file anew before it takes its place."""
    return file.with_suffix('.recovered')


def metadata_file(directory: Path) -> Path:
    """Returns rosbag2's description of the bag in a directory."""
    return directory / 'metadata.yaml'


def claim(directory: Path, name: str) -> BufferedWriter:
    """Creates the hidden directory of an episode; of several processes one succeeds.

    Returns:
        Its MCAP file, empty, locked and open for writing.

    Raises:
        EpisodeExistsError: If an episode of this name is finished, being written or cut off.
    """
    active = active_path(directory, name)
    try:
        active.mkdir()
    except FileExistsError:
        raise EpisodeExistsError(
            f'{active} exists: {name} is being written or was cut off'
        ) from None
    try:
        # Only now: whoever holds the claim is the only one to finish under this name.
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
    """Raises `OSError` if less than `minimum_bytes` can be written to the disk of `directory`."""
    status = os.statvfs(directory)
    free = status.f_bavail * status.f_frsize
    if free < minimum_bytes:
        raise OSError(
            errno.ENOSPC,
            f'{free / _MIB:.1f} MiB free on the disk, {minimum_bytes / _MIB:.1f} MiB wanted',
        )


def lock(stream: IO[bytes]) -> None:
    """Marks a file as being written for as long as this process lives and keeps it open."""
    # File systems without locks only lose the distinction between running and cut-off episodes.
    with suppress(OSError):
        fcntl.flock(stream, fcntl.LOCK_EX)


def try_lock(stream: IO[bytes], shared: bool = False) -> bool:
    """Does the same without waiting; returns False if another process holds the lock."""
    try:
        fcntl.flock(stream, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        pass  # No locks here, see `lock`.
    return True


def open_regular(path: Path) -> BinaryIO:
    """Opens a regular file for reading; no symbolic link is followed, no pipe waited for.

    Raises:
        OSError: If it is anything else; the reason says so.
    """
    if not stat.S_ISREG(path.lstat().st_mode):
        raise OSError(errno.EINVAL, 'is no regular file', str(path))
    flags = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags), 'rb')


def create(path: Path) -> BinaryIO:
    """Opens a file of its own for writing: what had the name before, a link too, is removed."""
    path.unlink(missing_ok=True)
    return path.open('xb')


def is_locked(path: Path) -> bool:
    """Whether a process is writing the regular file."""
    with open_regular(path) as stream:
        return not try_lock(stream, shared=True)


def sync(stream: IO[bytes]) -> None:
    """Brings what was written to the disk, not only to the operating system."""
    stream.flush()
    os.fsync(stream.fileno())


def sync_directory(path: Path) -> None:
    """Brings the entries of a directory to the disk."""
    descriptor = os.open(path, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_text(path: Path, text: str) -> None:
    """Writes a text file to the disk; see `create`."""
    with create(path) as stream:
        stream.write(text.encode())
        sync(stream)


def publish(active: Path, final: Path) -> None:
    """Gives a complete episode its name, in one step that a crash leaves done or not done."""
    sync_directory(active)
    active.rename(final)
    sync_directory(final.parent)
