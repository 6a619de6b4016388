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
        # Again: MuJoCo has looked at it when it was imported, which may have been before.
        _use(asked)
        return asked
    if sys.platform != 'linux' or os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY'):
        return 'glfw'
    for backend, library in _LIBRARIES.items():
        if _is_installed(library):
            _use(backend)
            return backend
    raise RuntimeError(ADVICE)


def _use(backend: str) -> None:
    if backend not in (*_LIBRARIES, 'glfw'):
        return
    try:
        gl_context.GLContext = import_module(f'mujoco.{backend}').GLContext
    except Exception as error:
        # PyOpenGL raises AttributeError, among others, where a library is missing.
        raise RuntimeError(f'{ADVICE} ({error})') from error


def _is_installed(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
