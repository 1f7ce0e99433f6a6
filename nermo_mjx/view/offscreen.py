"""The GL library for images without a display, chosen when the first one is rendered; `MUJOCO_GL` takes precedence."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import importlib
import importlib.util
import os
import sys
from typing import Any, Final

_EGL_PLATFORM_DEVICE: Final = 0x313F
_EGL_EXTENSIONS: Final = 0x3055


class RenderingUnavailable(RuntimeError):
    """This machine cannot render; the message says what to install."""


def require_gl() -> None:
    """Choose how to render on a Linux machine without a display, and check as far as possible that it works.

    EGL on a graphics card if there is one that starts, else OSMesa, else EGL in software; or what `MUJOCO_GL` says. To
    be called before `mujoco.Renderer` is made.

    Raises:
        RenderingUnavailable: with the remedy.
    """
    chosen_backend = os.environ.get("MUJOCO_GL", "")
    if chosen_backend.lower() in {"disable", "disabled", "off", "false", "0"}:
        raise RenderingUnavailable(
            "Rendering is switched off by MUJOCO_GL: unset it, or set it to egl or osmesa."
        )
    if (
        chosen_backend
        or sys.platform != "linux"
        or os.environ.get("DISPLAY")
        or os.environ.get("WAYLAND_DISPLAY")
    ):
        return
    backend = _headless_backend()
    if backend is None:
        raise RenderingUnavailable(
            "No rendering library was found on this machine without a display: install one, "
            "for instance with `apt-get install libosmesa6` (or libegl1 and libgl1)."
        )
    # MuJoCo reads MUJOCO_GL when this module is imported, and expects a display where it is not set.
    contexts: Any = importlib.import_module("mujoco.rendering.classic.gl_context")
    contexts.GLContext = importlib.import_module(f"mujoco.{backend}").GLContext


@functools.cache
def _headless_backend() -> str | None:
    if importlib.util.find_spec("OpenGL") is None:
        return None
    # MuJoCo refuses a backend that contradicts PyOpenGL's platform, if the user has set that.
    platform = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    allowed = {platform} if platform else {"egl", "osmesa"}
    if "egl" in allowed and _egl_starts(software=False):
        return "egl"
    if "osmesa" in allowed and _load("OSMesa", 8, 6, 9, 7) is not None:
        return "osmesa"
    if "egl" in allowed and _egl_starts(software=True):
        return "egl"
    return None


def _load(name: str, *versions: int) -> ctypes.CDLL | None:
    for file in (*(f"lib{name}.so.{version}" for version in versions), f"lib{name}.so"):
        with contextlib.suppress(OSError):
            return ctypes.CDLL(file)
    return None


def _egl_starts(*, software: bool) -> bool:
    """Whether an EGL device (a software one, or a graphics card) can be initialised the way MuJoCo will do it."""
    egl = _load("EGL", 1)
    if egl is None or (_load("OpenGL", 0) is None and _load("GL", 1) is None):
        return False
    find = egl.eglGetProcAddress
    find.restype, find.argtypes = ctypes.c_void_p, [ctypes.c_char_p]
    query, text, display_of = (
        find(name)
        for name in (b"eglQueryDevicesEXT", b"eglQueryDeviceStringEXT", b"eglGetPlatformDisplayEXT")
    )
    if not (query and text and display_of):
        return False
    handle, integer = ctypes.c_void_p, ctypes.c_int
    devices, count = (handle * 16)(), integer()
    query_devices = ctypes.CFUNCTYPE(
        ctypes.c_uint, integer, ctypes.POINTER(handle), ctypes.POINTER(integer)
    )(query)
    device_string = ctypes.CFUNCTYPE(ctypes.c_char_p, handle, integer)(text)
    platform_display = ctypes.CFUNCTYPE(handle, ctypes.c_uint, handle, handle)(display_of)
    egl.eglInitialize.argtypes, egl.eglTerminate.argtypes = [handle] * 3, [handle]
    if not query_devices(len(devices), devices, ctypes.byref(count)):
        return False
    for device in devices[: count.value]:
        if (b"software" in (device_string(device, _EGL_EXTENSIONS) or b"")) is not software:
            continue
        display = platform_display(_EGL_PLATFORM_DEVICE, device, None)
        if display and egl.eglInitialize(display, None, None):
            egl.eglTerminate(display)
            return True
    return False
