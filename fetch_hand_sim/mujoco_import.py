"""Import MuJoCo even if the OpenGL backend in `MUJOCO_GL` is missing.

`import mujoco` fails then, even in programs that never render. Programs that render get an error
from `simulation.opengl` that names the packages to install.
"""

import os
import sys
from importlib import import_module


def import_mujoco() -> None:
    """Import MuJoCo even if its OpenGL backend `MUJOCO_GL` does not work.

    A failed import is repeated without OpenGL, so that only rendering reports the backend. The
    variable keeps its value. Nothing is imported if it is not set.
    """
    asked = os.environ.get('MUJOCO_GL', '')
    if not asked or 'mujoco' in sys.modules:
        return
    try:
        import_module('mujoco')
    except ImportError:
        # Another module is missing; the first use of MuJoCo reports it.
        return
    except Exception:
        # PyOpenGL raises AttributeError for a missing library, MuJoCo RuntimeError for a bad name.
        _import_without_opengl(asked)


def _import_without_opengl(asked: str) -> None:
    os.environ['MUJOCO_GL'] = 'disable'
    try:
        import_module('mujoco')
    finally:
        os.environ['MUJOCO_GL'] = asked
