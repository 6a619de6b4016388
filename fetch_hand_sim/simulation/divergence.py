"""Which simulations MuJoCo has given up: after some of its warnings it throws the state away."""

from __future__ import annotations

from typing import Any

import numpy as np
from mujoco import mjtWarning
from numpy.typing import NDArray

_THROWN_AWAY = [
    mjtWarning.mjWARN_BADQPOS.value,
    mjtWarning.mjWARN_BADQVEL.value,
    mjtWarning.mjWARN_BADQACC.value,
]


class DivergenceWatch:
    """Finds what MuJoCo has given up since one last looked.

    Args:
        batch: The `mujoco.batch.Batch` of N simulations.
    """

    def __init__(self, batch: Any) -> None:
        self._batch = batch
        self.forget()

    def forget(self) -> None:
        """Counts no more what has been given up so far."""
        # The last axis is (last info, number).
        self._batch.warning[:, _THROWN_AWAY] = 0

    def found(self) -> NDArray[np.bool_]:
        """Which simulations were given up since this or `forget` was called, (N,)."""
        warning = self._batch.warning
        first, second, third = (warning[:, kind, 1] for kind in _THROWN_AWAY)
        lost = np.asarray(first + second + third > 0)
        if lost.any():
            # MuJoCo throws its counters away with the state: each loss is number one again.
            self.forget()
        return lost
