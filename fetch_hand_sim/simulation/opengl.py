"""Which OpenGL draws pictures where no display answers: EGL, else OSMesa.

MuJoCo takes GLFW unless `MUJOCO_GL` said otherwise before it was imported. The choice is made here
when the first picture is wanted instead, so that the order of imports does not matter.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import os
import sys
import warnings
from collections.abc import Iterator
from importlib import import_module
from typing import Any

from mujoco.rendering.classic import gl_context

_EGL, _OSMESA = 'libEGL.so.1', 'libOSMesa.so.8'
# From EGL_EXT_platform_device.
_PLATFORM_DEVICE = 0x313F
_MOST_DEVICES = 64
_BACKENDS = ('egl', 'osmesa', 'glfw')
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


@contextlib.contextmanager
def context_of_its_own() -> Iterator[None]:
    """Leaves the OpenGL context of this thread as it was, so that others draw in theirs.

    With EGL the one that is drawn in is free then, and any thread may take it.
    """
    before = _current_of_egl()
    try:
        yield
    finally:
        egl = sys.modules.get('mujoco.egl')
        if egl is not None and egl.EGL_DISPLAY is not None:
            none = egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_SURFACE, egl.EGL.EGL_NO_CONTEXT
            egl.EGL.eglMakeCurrent(egl.EGL_DISPLAY, *none)
            if before is not None:
                # Somebody may have destroyed it meanwhile.
                with contextlib.suppress(Exception):
                    egl.EGL.eglMakeCurrent(*before)


def _current_of_egl() -> tuple[Any, ...] | None:
    """Display, surfaces and context of this thread, as EGL takes them; None if there is none."""
    egl = sys.modules.get('mujoco.egl')
    if egl is None or egl.EGL_DISPLAY is None or not (context := egl.EGL.eglGetCurrentContext()):
        return None
    surfaces = (egl.EGL.eglGetCurrentSurface(each) for each in (egl.EGL.EGL_DRAW, egl.EGL.EGL_READ))
    return egl.EGL.eglGetCurrentDisplay(), *surfaces, context


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
    has_egl, has_osmesa = _is_installed(_EGL), _is_installed(_OSMESA)
    if has_egl and _has_device():
        backend = 'egl'
    elif has_osmesa:
        backend = 'osmesa'
    else:
        reason = ' (EGL is installed and finds no device)' if has_egl else ''
        raise RuntimeError(f'{ADVICE}{reason}')
    _use(backend)
    return backend


def _has_device() -> bool:
    """Whether EGL can draw on anything; its library alone, without drivers, cannot.

    Asked of EGL itself, because PyOpenGL stays with EGL for good once MuJoCo has tried it.
    """
    egl = ctypes.CDLL(_EGL)
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    query, display_of = (
        egl.eglGetProcAddress(name) for name in (b'eglQueryDevicesEXT', b'eglGetPlatformDisplayEXT')
    )
    if not (query and display_of):
        return False
    pointer, count = ctypes.c_void_p, ctypes.c_int(0)
    devices = (pointer * _MOST_DEVICES)()
    ask = ctypes.CFUNCTYPE(ctypes.c_uint, ctypes.c_int, pointer, pointer)(query)
    if not ask(_MOST_DEVICES, devices, ctypes.byref(count)):
        return False
    open_display = ctypes.CFUNCTYPE(pointer, ctypes.c_uint, pointer, pointer)(display_of)
    displays = (open_display(_PLATFORM_DEVICE, each, None) for each in devices[: count.value])
    # None is closed: MuJoCo opens the same one next.
    return any(display and egl.eglInitialize(pointer(display), None, None) for display in displays)


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
    if backend not in _BACKENDS:
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
