"""Which simulations MuJoCo has given up: after some of its warnings it throws the state away."""

from __future__ import annotations

from typing import Any

import numpy as np
from mujoco import mjtWarning
from numpy.typing import NDArray

_THROWN_AWAY = (
    mjtWarning.mjWARN_BADQPOS.value,
    mjtWarning.mjWARN_BADQVEL.value,
    mjtWarning.mjWARN_BADQACC.value,
)


class DivergenceWatch:
    """Finds what MuJoCo has given up since one last looked.

    Args:
        batch: The `mujoco.batch.Batch` of N simulations.
    """

    def __init__(self, batch: Any) -> None:
        self._batch = batch
        self._warnings = self._count()

    def forget(self) -> None:
        """Counts no more what has been given up so far."""
        self._warnings = self._count()

    def found(self) -> NDArray[np.bool_]:
        """Which simulations were given up since this or `forget` was called, (N,)."""
        before, self._warnings = self._warnings, self._count()
        return np.asarray(self._warnings > before)

    def _count(self) -> NDArray[np.int64]:
        """How often MuJoCo has given each simulation up, (N,)."""
        # The last axis of `Batch.warning` is (last info, number).
        first, second, third = (self._batch.warning[:, kind, 1] for kind in _THROWN_AWAY)
        return np.asarray(first + second + third)
