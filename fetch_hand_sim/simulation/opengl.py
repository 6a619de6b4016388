"""Choose the OpenGL backend: `MUJOCO_GL` if set, else the first usable of GLFW, EGL, OSMesa.

MuJoCo itself reads `MUJOCO_GL` when it is imported and defaults to GLFW. This module chooses at the
first picture, so the order of imports does not matter.
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
# Values of `MUJOCO_GL` that mean GLFW, which needs a display.
_WINDOWS = ('glfw', 'glx', 'enable', 'enabled', 'on', 'true', '1')
ADVICE = 'rendering needs OpenGL: apt install libegl1 libgl1-mesa-dri, or apt install libosmesa6'


def prepare_opengl() -> str:
    """Prepare this process for rendering; return the name of the backend.

    Raises:
        RuntimeError: If no backend works (the message names the packages to install), or if this
            process was forked from one that renders (OpenGL would wait for missing threads).
    """
    backend = _backend()
    if _process_that_draws() != os.getpid():
        raise RuntimeError(
            'this process was forked from one that renders, where OpenGL does not work; use the '
            "start method 'spawn' or 'forkserver', or fork before the first picture"
        )
    return backend


@contextlib.contextmanager
def context_of_its_own() -> Iterator[None]:
    """Run a block that may use another EGL context, then restore the context of this thread.

    Afterwards other threads can use the block's context. With GLFW and OSMesa nothing is restored.
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
                # The previous context may have been destroyed.
                with contextlib.suppress(Exception):
                    egl.EGL.eglMakeCurrent(*before)


def _current_of_egl() -> tuple[Any, ...] | None:
    """Return arguments of `eglMakeCurrent` that restore this thread's context; None without one."""
    egl = sys.modules.get('mujoco.egl')
    if egl is None or egl.EGL_DISPLAY is None or not (context := egl.EGL.eglGetCurrentContext()):
        return None
    surfaces = (egl.EGL.eglGetCurrentSurface(each) for each in (egl.EGL.EGL_DRAW, egl.EGL.EGL_READ))
    return egl.EGL.eglGetCurrentDisplay(), *surfaces, context


@functools.cache
def _process_that_draws() -> int:
    """Return the id of the process of the first call; forked processes inherit the value."""
    return os.getpid()


@functools.cache
def _backend() -> str:
    """Choose the backend.

    GLFW is not tried without a display, because a second attempt would end the process.
    """
    asked = os.environ.get('MUJOCO_GL', '').strip().lower()
    if asked in _WINDOWS and not _has_display():
        raise RuntimeError(f'{ADVICE} (MUJOCO_GL={asked} needs a display, but none is available)')
    if asked:
        # MuJoCo may have been imported before the variable was set.
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
        reason = ' (EGL is installed but finds no device)' if has_egl else ''
        raise RuntimeError(f'{ADVICE}{reason}')
    _use(backend)
    return backend


def _has_device() -> bool:
    """Return whether EGL finds a device; without drivers it finds none.

    Calls EGL directly, because PyOpenGL cannot change the backend after MuJoCo has tried EGL.
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
    # The display stays open, because MuJoCo opens the same one next.
    return any(display and egl.eglInitialize(pointer(display), None, None) for display in displays)


def _has_display() -> bool:
    """Return whether a window can be opened; `DISPLAY` alone may name a session that has ended."""
    if not (os.environ.get('DISPLAY') or os.environ.get('WAYLAND_DISPLAY')):
        return False
    try:
        return start_glfw()
    except ImportError:
        return False


def start_glfw() -> bool:
    """Start GLFW; return False without a display, raise ImportError if GLFW is not installed."""
    import glfw

    with warnings.catch_warnings():
        # The error of the caller is more helpful.
        warnings.simplefilter('ignore')
        return bool(glfw.init())


def _use(backend: str) -> None:
    if backend not in _BACKENDS:
        if not hasattr(gl_context, 'GLContext'):
            raise RuntimeError(
                f'rendering needs OpenGL: MUJOCO_GL={backend}; allowed: egl, osmesa, glfw'
            )
        return
    try:
        gl_context.GLContext = import_module(f'mujoco.{backend}').GLContext
    except Exception as error:
        # PyOpenGL raises AttributeError, among others, if a library is missing.
        raise RuntimeError(f'{ADVICE} ({error})') from error


def _is_installed(library: str) -> bool:
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True
