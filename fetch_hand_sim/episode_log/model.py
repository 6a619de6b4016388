"""The compiled model as part of an episode: its fingerprint, its text, and on request itself.

A compiled model is 7 to 13 MB (3.0 to 3.4 MB with zstd), nearly all of it meshes that are the same
in every episode, while the messages of an episode are about 0.1 MB. So the default is the MJCF text
of the model, 15 to 34 KB, which names its meshes and textures, and the SHA-256 of the compiled
model in the metadata. MuJoCo writes MJCF with six to seven digits; whoever needs every bit compiles
the model again from the versions in the metadata and compares the fingerprint, or logs the compiled
model too.
"""

from __future__ import annotations

import hashlib

import mujoco
import numpy as np
import zstandard

from fetch_hand_sim.episode_log.settings import Attachment


def compiled_bytes(model: mujoco.MjModel) -> bytes:
    """Returns the model as MuJoCo's binary format MJB, which only the same MuJoCo version reads."""
    buffer = np.empty(mujoco.mj_sizeModel(model), dtype=np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return buffer.tobytes()


def model_sha256(model: mujoco.MjModel) -> str:
    """Returns the fingerprint of a model, equal for equal models on one MuJoCo version."""
    return hashlib.sha256(compiled_bytes(model)).hexdigest()


def model_attachments(
    mjcf: str, model: mujoco.MjModel, with_compiled: bool = False
) -> list[Attachment]:
    """Returns what to store of a model; make it once and use it for all episodes.

    Args:
        mjcf: Text of the model, as `mujoco.MjSpec.to_xml` writes it.
        model: The compiled model.
        with_compiled: Whether to store the compiled model as well, 3 MB per episode.
    """
    attachments = [Attachment('model.xml', 'application/xml', mjcf.encode())]
    if with_compiled:
        compressed = zstandard.ZstdCompressor(level=10).compress(compiled_bytes(model))
        attachments.append(Attachment('model.mjb.zst', 'application/zstd', compressed))
    return attachments
