"""Which OpenGL draws pictures where no display answers: EGL, else OSMesa.

MuJoCo takes GLFW unless `MUJOCO_GL` said otherwise before it was imported. The choice is made here
when the first picture is wanted instead, so that the order of imports does not matter.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import warnings
from importlib import import_module

from mujoco.rendering.classic import gl_context

# What a backend needs on this machine, in the order of preference.
_LIBRARIES = {'egl': 'libEGL.so.1', 'osmesa': 'libOSMesa.so.8'}
# What MuJoCo takes GLFW for, which needs a display.
_WINDOWS = ('glfw', 'glx', 'enable', 'enabled', 'on', 'true', '1')
ADVICE = 'rendering needs OpenGL: apt install libegl1 libgl1-mesa-dri, or apt install libosmesa6'


def prepare_opengl() -> str:
    """Readies this process to draw.

    Returns:
        The backend's name.

    Raises:
        RuntimeError: If there is none; the message is one line with the packages to install. Or if
            this process was forked from one that draws: its OpenGL would wait for threads that
            stayed behind.
    """
    backend = _backend()
    if _process_that_draws() != os.getpid():
        raise RuntimeError(
            'this process was forked from one that draws pictures, and OpenGL does not come along: '
            "start it by 'spawn' or 'forkserver', or before the first picture"
        )
    return backend


@functools.cache
def _process_that_draws() -> int:
    """The process that asked first, in all that are forked from it."""
    return os.getpid()


@functools.cache
def _backend() -> str:
    """Chooses the backend for this process; what `MUJOCO_GL` says goes first, then a display.

    GLFW is not tried without a display: MuJoCo fails then, and ends the process at a second try.

    Raises:
        RuntimeError: If there is none.
    """
    asked = os.environ.get('MUJOCO_GL', '').strip().lower()
    if asked in _WINDOWS and not _has_display():
        raise RuntimeError(f'{ADVICE} (MUJOCO_GL={asked} needs a display, and none answers)')
    if asked:
        # Again: MuJoCo has looked at it when it was imported, which may have been before.
        _use(asked)
        return asked
    if _has_display():
        return 'glfw'
    for backend, library in _LIBRARIES.items():
        if _is_installed(library):
            _use(backend)
            return backend
    raise RuntimeError(ADVICE)


def _has_display() -> bool:
    """Whether a window could be opened; `DISPLAY` may be that of a session long gone."""
    if sys.platform != 'linux':
        return True
    if not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
        return False
    try:
        return start_glfw()
    except ImportError:
        return False


def start_glfw() -> bool:
    """Whether GLFW has a display, without its warning.

    Raises:
        ImportError: If it is not installed.
    """
    import glfw

    with warnings.catch_warnings():
        # It would say again, without the advice, what whoever asks says.
        warnings.simplefilter('ignore')
        return bool(glfw.init())


def _use(backend: str) -> None:
    if backend not in (*_LIBRARIES, 'glfw'):
        if not hasattr(gl_context, 'GLContext'):
            raise RuntimeError(
                f'rendering needs OpenGL: MUJOCO_GL={backend} has none; allowed: egl, osmesa, glfw'
            )
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
