"""Finds and compiles the MJCF models of the installed `gymnasium-robotics` package.

The package is only used as a container of assets: it is located, never imported, because importing
it on MuJoCo >= 3.17 registers environments that do not start.
"""

from __future__ import annotations

from importlib import util
from pathlib import Path

import mujoco


def asset_path(relative: str) -> Path:
    """Returns the path of an asset, for example `fetch/reach.xml`.

    Raises:
        FileNotFoundError: If `gymnasium-robotics` or the asset is missing.
    """
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
