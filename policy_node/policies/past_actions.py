"""Memory of a policy: its last actions, which tell what a delayed robot is about to do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Actions = NDArray[np.float32]


def past_before(state: Any, episode_start: Any, leading: tuple[int, ...], size: int) -> Actions:
    """Return the past actions (*leading, size) that precede a prediction, newest first.

    Args:
        state: What the last prediction returned; None at the start of all episodes.
        episode_start: Booleans (*leading,), True where an episode starts: its past is zeros.
        leading: Leading axes of the observation.
        size: Number of past actions times the action size.

    Raises:
        ValueError: If the state belongs to another batch or policy.
    """
    past = np.zeros((*leading, size), np.float32)
    if state is None:
        return past
    given = np.asarray(state, dtype=np.float32)
    if given.shape != past.shape:
        raise ValueError(f'state has shape {given.shape}; allowed: {past.shape}')
    if episode_start is None:
        return given
    return np.where(np.asarray(episode_start, dtype=np.bool_)[..., None], past, given)


def past_after(past: Actions, action: Actions) -> Actions:
    """Return the past actions once `action` (..., action size) has been sent."""
    kept = past[..., : past.shape[-1] - action.shape[-1]]
    return np.concatenate([action, kept], axis=-1).astype(np.float32)
