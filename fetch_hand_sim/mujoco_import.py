"""Import MuJoCo even if the OpenGL backend in the variable `MUJOCO_GL` is missing.

A plain `import mujoco` fails then, even in programs that never render. When a program renders,
`simulation.opengl` raises an error that names the packages to install.
"""

import os
import sys
from importlib import import_module


def import_mujoco() -> None:
    """Import MuJoCo if `MUJOCO_GL` is set; import it without OpenGL if that backend fails.

    `MUJOCO_GL` keeps its value, so that rendering reports the broken backend later.
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
