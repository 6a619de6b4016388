"""Array types."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# Positions, commands, rewards: float64, as in MuJoCo.
Array = NDArray[np.float64]
# Replay buffers and networks.
Array32 = NDArray[np.float32]
Flags = NDArray[np.bool_]
# (height, width, 3), RGB.
Picture = NDArray[np.uint8]
