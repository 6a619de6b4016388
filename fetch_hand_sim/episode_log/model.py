"""The model as part of an episode: its fingerprint, its text, and on request all of it.

A compiled model is 7 to 13 MB (3.0 to 3.4 MB with zstd), nearly all of it meshes that are the same
in every episode, while the messages of an episode are about 0.1 MB. So the default is the MJCF
text, 15 to 34 KB, which names its meshes and textures, and the SHA-256 of the compiled model in the
metadata, without the paths of its files. MuJoCo writes MJCF with about seven digits; for every bit,
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

from fetch_hand_sim.episode_log.settings import Attachment

# Fields of a compiled model that follow from where its files lie, and those that no file keeps.
_OF_PATHS = {'paths', 'npaths', 'hfield_pathadr', 'mesh_pathadr', 'skin_pathadr', 'tex_pathadr'}
_LEFT_OUT = frozenset({*_OF_PATHS, 'nbuffer', 'signature'})


def compiled_bytes(model: mujoco.MjModel) -> bytes:
    """Returns the model as MuJoCo's binary format MJB, which only the same MuJoCo version reads."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def model_sha256(model: mujoco.MjModel) -> str:
    """Returns the fingerprint of a model, equal for equal models on one MuJoCo version.

    Where its meshes and textures lie does not count: every machine has them elsewhere.
    """
    digest = hashlib.sha256()
    for name, content in _contents(model):
        digest.update(f'{name} {len(content)} '.encode())
        digest.update(content)
    return digest.hexdigest()


def former_model_sha256(model: mujoco.MjModel) -> str:
    """Returns the fingerprint that logs up to 1.0 have, in which paths count."""
    return hashlib.sha256(compiled_bytes(model)).hexdigest()


def _contents(struct: Any, prefix: str = '') -> Iterator[tuple[str, bytes]]:
    """Yields the values of a structure of MuJoCo, and of those in it, by name."""
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
    """Returns the MJCF at `path` as one text: files it includes are part of it, meshes are not."""
    text = mujoco.MjSpec.from_file(str(path)).to_xml()
    return Attachment('model.xml', 'application/xml', text.encode())


def compiled_attachment(model: mujoco.MjModel) -> Attachment:
    """Returns the compiled model, compressed with zstd to 3 MB; make it once for all episodes."""
    data = zstandard.ZstdCompressor(level=10).compress(compiled_bytes(model))
    return Attachment('model.mjb.zst', 'application/zstd', data)
