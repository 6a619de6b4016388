"""Read files of policies and runs within size limits; write them completely or not at all."""

from __future__ import annotations

import contextlib
import csv
import hashlib
import io
import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as from_bytes
from safetensors.numpy import save as to_bytes

from msgs_spec.text import one_line
from node_runtime.command_line import UsageError

# Bytes. The largest actor of the paper's size has 0.7 MB, a training state a few megabytes.
LARGEST_POLICY = 64 * 2**20
LARGEST_TENSOR_FILE = 2**30
# Parsed JSON needs many times the memory of its text; the header of an actor has a few kilobytes.
LARGEST_HEADER = 2**20


def read_file(path: Path, largest: int = LARGEST_POLICY) -> bytes:
    """Return the contents of a regular file.

    Raises:
        ValueError: If the file is missing, unreadable, not regular or larger than `largest` bytes.
    """
    try:
        if not path.is_file():
            raise ValueError(f'{path} is no file')
        with path.open('rb') as file:
            data = file.read(largest + 1)
    except OSError as error:
        raise ValueError(f'{path} cannot be read: {error.strerror or error}') from None
    if len(data) > largest:
        raise ValueError(f'{path} has more than {largest} bytes, the largest size allowed')
    return data


def write_file(path: Path, data: bytes) -> None:
    """Write a file under a temporary name and move it into place.

    Links, pipes and devices such as `/dev/stdout` are written directly.

    Raises:
        OSError: If writing fails. The error names the file. No partial file remains, except where a
            link was written directly.
    """
    is_special = path.exists() and not path.is_file() and not path.is_dir()
    if is_special or path.is_symlink():
        with _named(path):
            path.write_bytes(data)
    else:
        write_files({path: data})


def write_files(files: Mapping[Path, bytes]) -> None:
    """Write files that belong together; no file is replaced before all new ones are on disk.

    If two processes write at once, each file is complete and comes from one of them.

    Raises:
        OSError: If writing fails. The error names the file, and no partial file remains.
    """
    partials = {path: path.with_name(f'.{path.name}.{os.getpid()}.partial') for path in files}
    try:
        for path, partial in partials.items():
            with _named(path):
                path.parent.mkdir(parents=True, exist_ok=True)
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


@contextlib.contextmanager
def _named(path: Path) -> Iterator[None]:
    """Add `path` to an OSError of the `with` block; a full disk gives an error without a path."""
    try:
        yield
    except OSError as error:
        raise type(error)(error.errno, error.strerror, str(path)) from None


def to_json(values: Mapping[str, Any]) -> bytes:
    """Return the contents of a JSON file, with two spaces per level."""
    return (json.dumps(values, indent=2) + '\n').encode()


def to_csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> bytes:
    """Return the contents of a CSV file with `columns` as its header line."""
    file = io.StringIO()
    writer = csv.writer(file, lineterminator='\n')
    writer.writerow(columns)
    writer.writerows(rows)
    return file.getvalue().encode()


def sha256(data: bytes) -> str:
    """Return the SHA-256 of the contents of a file, hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def write_tensors(
    path: str | Path, tensors: Mapping[str, ArrayLike], metadata: dict[str, str]
) -> None:
    """Write arrays, or torch tensors on the CPU, by name to a safetensors file."""
    write_file(Path(path), tensor_bytes(tensors, metadata))


def tensor_bytes(tensors: Mapping[str, ArrayLike], metadata: dict[str, str]) -> bytes:
    """Return the contents of a safetensors file."""
    arrays = {name: np.asarray(value, order='C') for name, value in tensors.items()}
    return to_bytes(arrays, metadata)


def read_tensors(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the arrays and the metadata of a safetensors file, by name.

    Raises:
        ValueError: If the file cannot be read or is not a safetensors file.
    """
    return parse_tensors(read_file(Path(path), LARGEST_TENSOR_FILE), path)


def parse_tensors(data: bytes, path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Return the arrays and the metadata in the contents of a safetensors file.

    Raises:
        ValueError: If `data` is invalid or its header exceeds 1 MiB; the error names `path`.
    """
    end = 8 + int.from_bytes(data[:8], 'little')
    try:
        if len(data) >= end > LARGEST_HEADER:
            raise ValueError(f'header of {end} bytes; allowed: up to {LARGEST_HEADER}')
        arrays = from_bytes(data)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{path} is not a readable safetensors file: {one_line(error)}') from None
    # The library has checked the header but returns no metadata for bytes.
    return arrays, json.loads(data[8:end]).get('__metadata__') or {}


def require_writable(file: Path) -> None:
    """Create the folder of `file` and check that the file can be written.

    The file is not created or changed. Commands call this before long work.

    Raises:
        UsageError: If the file cannot be written.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        is_folder, exists = file.is_dir(), file.exists()
    except OSError as error:
        raise UsageError(f'{file} cannot be written: {error.strerror}') from None
    if is_folder:
        raise UsageError(f'{file} cannot be written: it is a folder')
    if not os.access(file if exists else file.parent, os.W_OK):
        raise UsageError(f'{file} cannot be written: it is read-only')
