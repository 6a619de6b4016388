"""Safetensors files as NumPy arrays: sizes are known before any of them is made."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from safetensors import SafetensorError
from safetensors.numpy import load as from_bytes
from safetensors.numpy import save as to_bytes

from msgs_spec.text import one_line
from policy_node.policies.files import read_file, write_file

# A training state with its optimisers has a few megabytes.
LARGEST_TENSOR_FILE = 2**30
# Text costs many times its bytes once it is parsed; that of an actor has a few kilobytes.
LARGEST_HEADER = 2**20


@dataclass(frozen=True, slots=True)
class TensorHeader:
    """What a safetensors file declares.

    Attributes:
        shapes: Shape of each tensor.
        types: Type of each tensor as the format names it, for example `F32`.
        metadata: Text by name.
    """

    shapes: dict[str, tuple[int, ...]]
    types: dict[str, str]
    metadata: dict[str, str]


def write_tensors(
    path: str | Path, tensors: Mapping[str, ArrayLike], metadata: dict[str, str]
) -> None:
    """Writes arrays, or torch tensors on the CPU; the file is complete or not there."""
    write_file(Path(path), tensor_bytes(tensors, metadata))


def tensor_bytes(tensors: Mapping[str, ArrayLike], metadata: dict[str, str]) -> bytes:
    """Returns what `write_tensors` writes."""
    arrays = {name: np.asarray(value, order='C') for name, value in tensors.items()}
    return to_bytes(arrays, metadata)


def read_tensors(path: str | Path) -> tuple[dict[str, NDArray[Any]], dict[str, str]]:
    """Reads arrays and metadata.

    Raises:
        ValueError: If the file cannot be read or is no safetensors file.
    """
    data = read_file(Path(path), LARGEST_TENSOR_FILE)
    return parse_tensors(data, path), parse_header(data, path).metadata


def parse_tensors(data: bytes, path: str | Path) -> dict[str, NDArray[Any]]:
    """Returns the arrays in the bytes of a file.

    Raises:
        ValueError: If they are none of a safetensors file; `path` names them.
    """
    try:
        return from_bytes(data)
    except (SafetensorError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f'{path} is not a readable safetensors file: {one_line(error)}') from None


def parse_header(data: bytes, path: str | Path) -> TensorHeader:
    """Returns what the bytes of a file declare; the arrays stay untouched.

    Raises:
        ValueError: If they are none of a safetensors file; `path` names them.
    """
    try:
        end = 8 + int.from_bytes(data[:8], 'little')
        if len(data) < max(end, 8):
            raise ValueError('it ends within its header')
        if end > LARGEST_HEADER:
            raise ValueError(f'header of {end} bytes; allowed: up to {LARGEST_HEADER}')
        entries = json.loads(data[8:end])
        metadata = entries.pop('__metadata__', {})
        return TensorHeader(
            shapes={name: tuple(entry['shape']) for name, entry in entries.items()},
            types={name: str(entry['dtype']) for name, entry in entries.items()},
            metadata={name: str(text) for name, text in metadata.items()},
        )
    except (AttributeError, KeyError, RecursionError, TypeError, ValueError) as error:
        raise ValueError(f'{path} is not a readable safetensors file: {one_line(error)}') from None
