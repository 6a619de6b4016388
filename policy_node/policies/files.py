"""Files of policies: read whole and within bounds, written whole or not at all."""

from __future__ import annotations

import contextlib
import glob
import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

# The largest actor of the paper's size has 0.7 MB.
LARGEST_POLICY = 64 * 2**20
# Seconds.
_LONGEST_WRITE = 3600.0


def read_file(path: Path, largest: int = LARGEST_POLICY) -> bytes:
    """Reads a regular file.

    Raises:
        ValueError: If it cannot be read, is none, or has more than `largest` bytes.
    """
    try:
        if not path.is_file():
            raise ValueError(f'{path} is no file')
        with path.open('rb') as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise ValueError(f'{path} cannot be read: {error.strerror or error}') from None
    if len(data) > largest:
        raise ValueError(f'{path} has more than {largest} bytes, which is the most allowed')
    return data


def write_file(path: Path, data: bytes) -> None:
    """Writes a file under a temporary name and moves it into place.

    What is no regular file, such as a pipe or a link, is written to as it is.

    Raises:
        OSError: If that fails, and names the file; nothing is left behind.
    """
    is_special = path.exists() and not path.is_file() and not path.is_dir()
    # `/dev/stdout` is one, to whatever the output goes to.
    if is_special or path.is_symlink():
        with _named(path):
            path.write_bytes(data)
    else:
        write_files({path: data})


def write_files(files: Mapping[Path, bytes]) -> None:
    """Writes files that belong together: none is replaced before there was room for all.

    Of two processes that write one at once the later one's stays, whole.

    Args:
        files: Contents by path.

    Raises:
        OSError: If that fails, and names the file; nothing is left behind.
    """
    partials = {path: path.with_name(f'.{path.name}.{os.getpid()}.partial') for path in files}
    try:
        for path, partial in partials.items():
            with _named(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                _clear_away_leftovers(path)
                with partial.open('wb') as file:
                    file.write(files[path])
                    file.flush()
                    os.fsync(file.fileno())
        for path, partial in partials.items():
            with _named(path):
                os.replace(partial, path)
    except BaseException:
        for partial in partials.values():
            with contextlib.suppress(OSError):
                partial.unlink(missing_ok=True)
        raise


def _clear_away_leftovers(path: Path) -> None:
    """Removes what processes left that were killed while they wrote a file."""
    for left in path.parent.glob(f'.{glob.escape(path.name)}.*.partial'):
        number = left.name.split('.')[-2]
        with contextlib.suppress(OSError):
            # Of this machine, or of one that shares the disk: an hour is longer than writing takes.
            is_old = time.time() - left.stat().st_mtime > _LONGEST_WRITE
            if is_old and number.isdigit() and not Path(f'/proc/{number}').exists():
                left.unlink()


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Names the file in errors: Python names none for a full disk, and else the partial one."""
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None


def to_json(values: Mapping[str, Any]) -> bytes:
    """Contents of a JSON file, as all commands here write and print it."""
    return (json.dumps(values, indent=2) + '\n').encode()


def sha256(data: bytes) -> str:
    """Fingerprint of a policy's file, hexadecimal."""
    return hashlib.sha256(data).hexdigest()
