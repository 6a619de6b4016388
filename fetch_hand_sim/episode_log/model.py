"""The model in an episode: its fingerprint, its MJCF text, and on request the compiled model.

A compiled model has 7 to 13 MB (3.0 to 3.4 MB with zstd), mostly meshes that are the same in every
episode. The messages of an episode have about 0.1 MB. So every episode contains the MJCF text, 15
to 34 KB, which names its meshes and textures; the metadata contain the SHA-256 of the compiled
model without the paths of its files. MuJoCo writes MJCF with about seven digits. For every bit,
compile the model with the versions in the metadata and compare the fingerprint, or store the
compiled model too.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import zstandard

from fetch_hand_sim.episode_log.bag import Attachment

# Fields of a compiled model that depend on the place of its files, and fields that no file keeps.
_OF_PATHS = {'paths', 'npaths', 'hfield_pathadr', 'mesh_pathadr', 'skin_pathadr', 'tex_pathadr'}
_LEFT_OUT = frozenset({*_OF_PATHS, 'nbuffer', 'signature'})


def compiled_bytes(model: mujoco.MjModel) -> bytes:
    """Return the model as MuJoCo's binary format MJB, which only the same MuJoCo version reads."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def model_sha256(model: mujoco.MjModel) -> str:
    """Return the fingerprint of a model, equal for equal models on one MuJoCo version.

    The place of its meshes and textures does not count: it differs between machines.
    """
    digest = hashlib.sha256()
    for name, content in _contents(model):
        digest.update(f'{name} {len(content)} '.encode())
        digest.update(content)
    return digest.hexdigest()


def former_model_sha256(model: mujoco.MjModel) -> str:
    """Return the fingerprint of logs up to 1.0, which depends on paths."""
    return hashlib.sha256(compiled_bytes(model)).hexdigest()


def _contents(struct: Any, prefix: str = '') -> Iterator[tuple[str, bytes]]:
    """Yield names and values of a structure of MuJoCo and of the structures in it."""
    for name in dir(struct):
        if name.startswith('_') or name in _LEFT_OUT:
            continue
        value = getattr(struct, name)
        if isinstance(value, np.ndarray):
            yield prefix + name, value.tobytes()
        elif isinstance(value, bytes | int | float):
            yield prefix + name, repr(value).encode()
        elif not callable(value):
            yield from _contents(value, f'{prefix}{name}.')


def mjcf_attachment(path: Path) -> Attachment:
    """Return the MJCF at `path` as one text, with included files and without meshes."""
    text = mujoco.MjSpec.from_file(str(path)).to_xml()
    return Attachment('model.xml', 'application/xml', text.encode())


def compiled_attachment(model: mujoco.MjModel) -> Attachment:
    """Return the compiled model, compressed with zstd to 3 MB; make it once for all episodes."""
    data = zstandard.ZstdCompressor(level=10).compress(compiled_bytes(model))
    return Attachment('model.mjb.zst', 'application/zstd', data)
