"""The arrays that nearly everything here computes with and draws."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Positions, commands, rewards: float64 throughout, as MuJoCo computes.
Array = NDArray[np.float64]
# What replays and networks hold.
Array32 = NDArray[np.float32]
# Whether, for each of many.
Flags = NDArray[np.bool_]
# Rows, columns, RGB.
Picture = NDArray[np.uint8]
