"""Finds and compiles the MJCF models of the installed `gymnasium-robotics` package, readies MuJoCo.

The package is only used as a container of assets: it is located, never imported, because importing
it on MuJoCo >= 3.17 registers environments that do not start.
"""

from __future__ import annotations

from importlib import util
from pathlib import Path

import mujoco
import numpy as np

from msgs_spec.arrays import Array

# That of a geom whose MJCF says none (`rgba` in MuJoCo's XML reference).
_NO_COLOR = np.array([0.5, 0.5, 0.5, 1.0])


def asset_path(relative: str) -> Path:
    """Returns the path of an asset, for example `fetch/reach.xml`; an absolute path stays.

    Raises:
        FileNotFoundError: If `gymnasium-robotics` or the asset is missing.
    """
    if Path(relative).is_absolute():
        return Path(relative)
    spec = util.find_spec('gymnasium_robotics')
    if spec is None or spec.origin is None:
        raise FileNotFoundError(
            'the robot models come with the Python package gymnasium-robotics, which is not '
            'installed: pip install gymnasium-robotics==1.4.2'
        )
    path = Path(spec.origin).parent / 'envs' / 'assets' / relative
    if not path.exists():
        raise FileNotFoundError(f'gymnasium-robotics has no asset {relative!r}: {path} is missing')
    return path


def load_spec(relative: str) -> mujoco.MjSpec:
    """Reads an MJCF asset, for example `hand/reach.xml`, for editing and compiling."""
    return mujoco.MjSpec.from_file(str(asset_path(relative)))


def load_model(relative: str) -> mujoco.MjModel:
    """Compiles an MJCF asset as it is published."""
    return load_spec(relative).compile()


def geom_color(model: mujoco.MjModel, geom: int) -> Array:
    """Returns the colour (4,) that MuJoCo draws: a geom's own, else that of its material."""
    own = np.array(model.geom_rgba[geom], dtype=np.float64)
    material = int(model.geom_matid[geom])
    if material < 0 or not np.array_equal(own, _NO_COLOR):
        return own
    return np.array(model.mat_rgba[material], dtype=np.float64)
