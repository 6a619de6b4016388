"""Which OpenGL draws pictures where there is no display: EGL, else OSMesa.

MuJoCo takes GLFW unless `MUJOCO_GL` said otherwise before it was imported. The choice is made here
when the first picture is wanted instead, so that the order of imports does not matter.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
from importlib import import_module

from mujoco.rendering.classic import gl_context

# What a backend needs on this machine, in the order of preference.
_LIBRARIES = {'egl': 'libEGL.so.1', 'osmesa': 'libOSMesa.so.8'}
ADVICE = 'rendering needs OpenGL: apt install libegl1 libgl1-mesa-dri, or apt install libosmesa6'


@functools.cache
def prepare_opengl() -> str:
    """Chooses the backend for this process; what `MUJOCO_GL` or a display says goes first.

    Returns:
        Its name.

    Raises:
        RuntimeError: If there is none; the message is one line with the packages to install.
    """
    asked = os.environ.get('MUJOCO_GL', '').strip().lower()
    if asked:
        return asked
    if sys.platform != 'linux' or os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'):
        return 'glfw'
    for backend, library in _LIBRARIES.items():
        if _is_installed(library):
            gl_context.GLContext = import_module(f'mujoco.{backend}').GLContext
            return backend
    raise RuntimeError(ADVICE)


def _is_installed(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
