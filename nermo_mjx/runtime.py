"""What must be settled before JAX and MuJoCo start: threads, compiler, its cache, and the GL library for rendering.

`nermo_mjx/__init__.py` calls `configure()` before anything else. It only sets environment variables (and JAX options,
where JAX was imported earlier), imports neither JAX nor MuJoCo, and never overrides what the user has set.
`nermo_mjx.physics` calls `configure_dispatch()`, for which JAX has no environment variable.
"""

from __future__ import annotations

import contextlib
import ctypes
import hashlib
import importlib
import importlib.util
import os
import platform
import sys
from pathlib import Path
from typing import Any, Final

#: Below this many processors JAX's CPU runtime gets `SAFE_THREADS` threads. JAX 0.10.2 hangs (all threads idle, no
#: error) in a vmapped MJX step of 64 worlds or more with two threads; with one or eight it does not.
SAFE_THREADS: Final = 8
#: Worlds per batch that stay well below the hang where the number of threads can no longer be changed.
GUARDED_BATCH: Final = 32
MIN_COMPILE_SECONDS: Final = 0.5
#: How XLA compiles for a CPU. It ends a process whose flags it does not know; every JAX that may be installed knows
#: these. The first is its older way to compile fused loops: a walk in MJX compiles in 16 s instead of 31, and runs in
#: 0.5 s instead of 1.2. With the second, a loop that touches less than 4 MB becomes one function, else (from 1 KB on)
#: one of each fused expression, handed out to threads: `physics.packed_loop` is such a loop, of 0.6 MB.
COMPILER_FLAGS: Final = (
    "--xla_cpu_use_fusion_emitters=false",
    "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=4000000",
)

_EGL_PLATFORM_DEVICE: Final = 0x313F
_EGL_EXTENSIONS: Final = 0x3055
_started_unguarded = False
_gl_problem: str | None = None
_late_backend: str | None = None


class BackendUnavailable(RuntimeError):
    """JAX cannot compute where the user wants it to; the message says what to do."""


class RenderingUnavailable(RuntimeError):
    """Nothing on this machine can draw; the message says what to install."""


def configure() -> None:
    """Settle threads, compiler, cache and GL; to be called before JAX's first use and MuJoCo's import."""
    configure_threads()
    configure_compiler()
    configure_cache()
    choose_gl()


# --- threads


def configure_threads() -> None:
    """Give JAX's CPU runtime enough threads on a small machine (`PJRT_NPROC`), so that it cannot hang."""
    global _started_unguarded
    if cpu_count() >= SAFE_THREADS:
        return
    if "PJRT_NPROC" in os.environ:
        _started_unguarded = _started_unguarded or os.environ["PJRT_NPROC"] in {"2", "3"}
        return
    if _jax_started():
        _started_unguarded = True
    else:
        os.environ["PJRT_NPROC"] = str(SAFE_THREADS)


def cpu_batch_limit() -> int | None:
    """Most worlds that one vmapped MJX program may hold on the CPU backend; None where there is no limit.

    There is a limit only if JAX had computed something before `nermo_mjx` was imported, on a machine of few processors
    and without `PJRT_NPROC`, or if the user set `PJRT_NPROC` to a number of threads that is known to hang. The mjx
    engine then runs a larger batch in parts of this size; results are the same.
    """
    return GUARDED_BATCH if _started_unguarded else None


def cpu_count() -> int:
    """Processors this process may use, counted as JAX does."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _jax_started() -> bool:
    """Whether JAX has started its backends, after which `PJRT_NPROC` is no longer read."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None:
        return False
    started = getattr(bridge, "backends_are_initialized", None)
    return True if started is None else bool(started())


# --- compiler


def configure_compiler() -> None:
    """Have programs for the CPU compiled the faster way, unless the user's `XLA_FLAGS` say otherwise."""
    if _jax_started():
        return
    for flag in COMPILER_FLAGS:
        flags = os.environ.get("XLA_FLAGS", "")
        if flag.split("=")[0] not in flags:
            os.environ["XLA_FLAGS"] = f"{flags} {flag}".strip()


def configure_dispatch() -> None:
    """Have a program for the CPU run on the thread that calls it, if JAX has not started yet.

    JAX hands it to another thread and returns at once. For the loop of a few worlds, called between two ticks of
    physics that keeps all cores busy, the change of threads takes longer than the loop.
    """
    jax: Any = importlib.import_module("jax")
    jax.config.update("jax_cpu_enable_async_dispatch", False)


# --- backend


def require_backend() -> None:
    """Start JAX on its platform, a GPU where there is one.

    Raises:
        BackendUnavailable: `JAX_PLATFORMS` asks for one that this machine does not have, with the remedy.
    """
    jax: Any = importlib.import_module("jax")
    try:
        jax.devices()
    except (RuntimeError, AssertionError) as error:  # the latter from JAX 0.10 where no plugin knows the platform
        chosen = jax.config.jax_platforms
        if not chosen:
            raise
        reason = str(error).partition("\n")[0]
        raise BackendUnavailable(
            f"JAX_PLATFORMS is {chosen!r}, and JAX cannot compute there{f' ({reason})' if reason else ''}: unset it to "
            "compute on the CPU; a GPU needs NVIDIA's driver and nermo-mjx[cuda]."
        ) from None


# --- cache


def configure_cache() -> None:
    """Switch JAX's persistent compilation cache on, unless the user has chosen one or the directory is not writable."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ or os.environ.get("JAX_ENABLE_COMPILATION_CACHE", "1") in {
        "0",
        "false",
    }:
        return
    jax = sys.modules.get("jax")
    if jax is not None and jax.config.jax_compilation_cache_dir:
        return
    directory = cache_directory() / "jax" / _processor_tag()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(directory, os.W_OK | os.X_OK):
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(directory)
    least = os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", str(MIN_COMPILE_SECONDS))
    if jax is not None:
        jax.config.update("jax_compilation_cache_dir", str(directory))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", float(least))


def cache_directory() -> Path:
    """Where nermo_mjx keeps what it can make again: `$NERMO_MJX_CACHE`, or the platform's user cache directory."""
    if chosen := os.environ.get("NERMO_MJX_CACHE"):
        return Path(chosen).expanduser()
    if sys.platform == "darwin":
        base = Path("~/Library/Caches").expanduser()
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path("~/AppData/Local").expanduser())
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return base / "nermo_mjx"


def _processor_tag() -> str:
    """Names this kind of processor: compiled CPU code from a home directory shared with a newer one would not run."""
    features = platform.processor()
    with contextlib.suppress(OSError), open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
        features = next((line for line in file if line.lower().startswith(("flags", "features"))), features)
    digest = hashlib.sha256(" ".join(sorted(features.split())).encode()).hexdigest()
    return f"{platform.machine() or 'cpu'}-{digest[:8]}"


# ------------------------------------------------------------------------------------------------------------------ GL


def choose_gl() -> str | None:
    """Choose how to draw on a Linux machine without a display, and tell MuJoCo by `MUJOCO_GL`.

    EGL on a graphics card if there is one that starts, else OSMesa, else EGL in software. Returns the backend in force:
    "egl", "osmesa", what the user set, or None for MuJoCo's own default. Nothing is raised here; see `require_gl`.
    """
    global _gl_problem, _late_backend
    if chosen := os.environ.get("MUJOCO_GL"):
        return chosen
    if sys.platform != "linux" or os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"):
        return None
    backend = _headless_backend()
    if backend is None:
        _gl_problem = (
            "No library to draw with was found on this machine without a display: install one, "
            "for instance with `apt-get install libosmesa6` (or libegl1 and libgl1)."
        )
        return None
    os.environ["MUJOCO_GL"] = backend
    if "mujoco" in sys.modules:  # which read the variable at its import, and expects a display
        _late_backend = backend
    return backend


def require_gl() -> None:
    """Make sure that rendering works, as far as that can be told beforehand; call it before `mujoco.Renderer`.

    Raises:
        RenderingUnavailable: with the remedy.
    """
    global _late_backend
    if _gl_problem is not None:
        raise RenderingUnavailable(_gl_problem)
    if os.environ.get("MUJOCO_GL", "").lower() in {"disable", "disabled", "off", "false", "0"}:
        raise RenderingUnavailable("Rendering is switched off by MUJOCO_GL: unset it, or set it to egl or osmesa.")
    if _late_backend is not None:
        late: Any = importlib.import_module("mujoco.rendering.classic.gl_context")
        late.GLContext = importlib.import_module(f"mujoco.{_late_backend}").GLContext
        _late_backend = None


def _headless_backend() -> str | None:
    if importlib.util.find_spec("OpenGL") is None:
        return None
    # MuJoCo refuses a backend that contradicts PyOpenGL's platform, if the user has set that.
    wanted = os.environ.get("PYOPENGL_PLATFORM", "").lower()
    allowed = {wanted} if wanted else {"egl", "osmesa"}
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
        find(name) for name in (b"eglQueryDevicesEXT", b"eglQueryDeviceStringEXT", b"eglGetPlatformDisplayEXT")
    )
    if not (query and text and display_of):
        return False
    handle, integer = ctypes.c_void_p, ctypes.c_int
    devices, count = (handle * 16)(), integer()
    query_devices = ctypes.CFUNCTYPE(ctypes.c_uint, integer, ctypes.POINTER(handle), ctypes.POINTER(integer))(query)
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
