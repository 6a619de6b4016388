"""MuJoCo without the OpenGL that `MUJOCO_GL` asks for, where that is not there.

`import mujoco` fails then, also in what draws nothing. Who does draw is told what to install by
`simulation.opengl`.
"""

import os
import sys
from importlib import import_module


def import_mujoco() -> None:
    """Imports MuJoCo if `MUJOCO_GL` may keep it from being imported later; leaves it as it is."""
    asked = os.environ.get('MUJOCO_GL', '')
    if not asked or 'mujoco' in sys.modules:
        return
    try:
        import_module('mujoco')
    except ImportError:
        # Something else is missing; whoever needs MuJoCo hears of it.
        return
    except Exception:
        # AttributeError of PyOpenGL where a library is missing, RuntimeError of another name.
        _import_without_opengl(asked)


def _import_without_opengl(asked: str) -> None:
    os.environ['MUJOCO_GL'] = 'disable'
    try:
        import_module('mujoco')
    finally:
        os.environ['MUJOCO_GL'] = asked
