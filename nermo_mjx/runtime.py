"""Process-wide settings, made when a program is first compiled: threads, compiler options, cache.

Importing the package changes nothing in the process. When a simulator is created, `start_jax` starts JAX as this
package needs it, unless the user has started it before, and sets a cache directory for compiled programs, unless the
user has one; compiler options are passed with each program (`compiler_options`). User settings always take
precedence: `PJRT_NPROC`, `XLA_FLAGS`, JAX's own settings; to keep all of this unchanged, call `jax.devices()` first.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib
import os
import platform
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

#: Below this many processors JAX's CPU runtime gets `SAFE_THREADS` threads. JAX 0.10.2 hangs (all threads idle, no
#: error) in a vmapped MJX step of 64 worlds or more with two threads; with one or eight it does not.
SAFE_THREADS: Final = 8
#: Worlds per batch that stay well below the hang where the number of threads can no longer be changed.
GUARDED_BATCH: Final = 32
#: A walk starts with several programs that compile in 0.1 to 0.5 s each; from the cache they take a few milliseconds.
MIN_COMPILE_SECONDS: Final = 0.1
#: Largest size of the cache of compiled programs; the longest unused are removed. A program of a walk is 1 to 5 MB.
MAX_CACHE_BYTES: Final = 2 * 1024**3
#: XLA options for a CPU: its older emitter for fused loops, with which a walk in MJX compiles in 16 s instead of
#: 31, and runs in 0.5 s instead of 1.2. JAX 0.12 has no choice of emitters any more.
COMPILER_OPTIONS: Final[Mapping[str, bool]] = {"xla_cpu_use_fusion_emitters": False}
#: What XLA reads once, when JAX starts, and takes from no program: a loop that touches less than 4 MB becomes one
#: function, else (from 1 KB on) one of each fused expression, handed out to threads. `physics.engine` is such a
#: loop, of 0.6 MB: trainings take 13 % less processor time. JAX 0.12 gives the same bits in the same time without it.
EXTRA_OPTIONS: Final = "--xla_backend_extra_options=xla_cpu_small_while_loop_byte_threshold=4000000"
#: Environment variable with the number of processors that the engine `c` uses, where a caller does not say.
THREADS_VARIABLE: Final = "NERMO_MJX_THREADS"

_started_unguarded = False
_started_before = False
_settled = False


class BackendUnavailable(RuntimeError):
    """JAX cannot compute where the user wants it to; the message says what to do."""


# --- JAX


def start_jax() -> None:
    """Start JAX on its platform, a GPU if available, and set its cache directory; once per process.

    JAX's CPU runtime gets enough threads not to hang on a small machine, runs a program on the thread that calls it
    (for the loop of a few worlds, between two ticks of physics that keeps all cores busy, the change of threads takes
    longer than the loop), and compiles small loops as `EXTRA_OPTIONS` say. The environment is as before afterwards.
    None of this happens if JAX has started before.

    Raises:
        BackendUnavailable: `JAX_PLATFORMS` asks for a platform that this machine does not have, with the remedy.
    """
    global _settled, _started_unguarded, _started_before
    if _settled:
        return
    jax: Any = importlib.import_module("jax")
    _settle_cache(jax)
    small, setting = cpu_count() < SAFE_THREADS, os.environ.get("PJRT_NPROC")
    _started_before = _jax_started()
    if _started_before:
        _started_unguarded = small and setting in {None, "2", "3"}
    else:
        _started_unguarded = small and setting in {"2", "3"}
        with _starting(jax, {"PJRT_NPROC": str(SAFE_THREADS)} if small and setting is None else {}):
            _find_devices(jax)
    _settled = True


def _find_devices(jax: Any) -> None:
    try:
        jax.devices()
    except (
        RuntimeError,
        AssertionError,
    ) as error:  # the latter from JAX 0.10 where no plugin knows the platform
        platforms = jax.config.jax_platforms
        if not platforms:
            raise
        reason = str(error).partition("\n")[0]
        raise BackendUnavailable(
            f"JAX_PLATFORMS is {platforms!r}, and JAX cannot compute there{f' ({reason})' if reason else ''}: unset it to "
            "compute on the CPU; a GPU needs NVIDIA's driver and nermo-mjx[cuda]."
        ) from None


@contextlib.contextmanager
def _starting(jax: Any, settings: dict[str, str]) -> Iterator[None]:
    """The environment that JAX and XLA read on start-up, for the duration of the start."""
    flags, dispatch = os.environ.get("XLA_FLAGS", ""), "jax_cpu_enable_async_dispatch"
    if jax.__version_info__ < (0, 12) and "xla_backend_extra_options" not in flags:
        settings = settings | {"XLA_FLAGS": f"{flags} {EXTRA_OPTIONS}".strip()}
    environment = {name: os.environ.get(name) for name in settings}
    asynchronous = jax.config.read(dispatch)
    os.environ.update(settings)
    jax.config.update(dispatch, False)
    try:
        yield
    finally:
        jax.config.update(dispatch, asynchronous)
        for name, value in environment.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _jax_started() -> bool:
    """Whether JAX has started its backends, after which `PJRT_NPROC` is no longer read."""
    bridge = sys.modules.get("jax._src.xla_bridge")
    if bridge is None:
        return False
    started = getattr(bridge, "backends_are_initialized", None)
    return True if started is None else bool(started())


@functools.cache
def callback_device() -> Any:
    """The device, for `jax.default_device`, of programs that a callback within another program runs; None for any.

    Where the user started JAX, a callback holds one of the few threads that programs run on, and would wait for ever if
    its own programs needed them all. They get a CPU whose programs run on the thread that calls them.
    """
    start_jax()
    if not _started_before:
        return None
    client: Any = importlib.import_module("jaxlib.xla_client").make_cpu_client(asynchronous=False)
    return client.local_devices()[0]


def processor_device() -> Any:
    """The device, for `jax.default_device`, of the engine `c`'s controller; None for JAX's own default.

    It is a processor, where the bodies are: an accelerator would be asked, and waited for, in every control tick.
    """
    jax: Any = importlib.import_module("jax")
    device = jax.config.jax_default_device
    if device is None and jax.default_backend() != "cpu":
        with contextlib.suppress(RuntimeError):  # `JAX_PLATFORMS` may name the accelerator alone
            return jax.local_devices(backend="cpu")[0]
    return device


def compiler_options(level: int | None = None) -> dict[str, bool | int]:
    """Options for `jax.jit(..., compiler_options=...)` of a program of physics; also for users' own, as of a `Rollout`.

    >>> import jax
    >>> float(jax.jit(lambda x: 2.0 * x, compiler_options=compiler_options())(1.5))
    3.0

    Those of `COMPILER_OPTIONS` that this XLA knows and `XLA_FLAGS` does not decide; none for accelerators.

    Args:
        level: how much XLA optimizes, 0 to 3; by default 3. For a program that runs once, 0 saves half of the time.
    """
    start_jax()
    jax: Any = importlib.import_module("jax")
    platform = getattr(jax.config.jax_default_device, "platform", None) or jax.default_backend()
    return dict(_known_options(level)) if platform == "cpu" else {}


@functools.cache
def _known_options(level: int | None) -> dict[str, bool | int]:
    """`compiler_options` for a processor."""
    jax: Any = importlib.import_module("jax")
    options: dict[str, bool | int] = dict(COMPILER_OPTIONS)
    if level is not None:
        options["xla_backend_optimization_level"] = level
    supported = {}
    with jax.default_device(processor_device()):
        for name, value in options.items():
            if name in os.environ.get("XLA_FLAGS", ""):
                continue
            # An option that a later XLA no longer has is left out; this only costs time.
            with contextlib.suppress(RuntimeError):
                jax.jit(lambda x: x, compiler_options={name: value}).lower(0.0).compile()
                supported[name] = value
    return supported


# --- threads


def cpu_batch_limit() -> int | None:
    """Most worlds that one vmapped MJX program may hold on the CPU backend; None where there is no limit.

    There is a limit only if JAX had computed something before the first simulator was made, on a machine of few
    processors and without `PJRT_NPROC`, or if the user set `PJRT_NPROC` to a number of threads that is known to hang.
    The mjx engine then runs a larger batch in parts of this size; results are the same.
    """
    start_jax()
    return GUARDED_BATCH if _started_unguarded else None


def cpu_count() -> int:
    """Processors this process may use, counted as JAX does."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def thread_count(requested: int | None = None) -> int:
    """Processors that the engine `c` uses: as wanted, or `$NERMO_MJX_THREADS`, or all.

    Raises:
        ValueError: not a whole number from 1 on, as a sentence.
    """
    name, value = "threads", str(requested)
    if requested is None:
        name, value = THREADS_VARIABLE, os.environ.get(THREADS_VARIABLE) or str(cpu_count())
    if not value.isdecimal() or int(value) < 1:
        raise ValueError(f"{name} is {value}: allowed is a whole number from 1 on.")
    return int(value)


# --- cache


def _settle_cache(jax: Any) -> None:
    """Switch JAX's persistent compilation cache on, unless the user has chosen one or the directory is not writable."""
    if jax.config.jax_compilation_cache_dir or not jax.config.jax_enable_compilation_cache:
        return
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:  # set, but empty: none is wanted
        return
    directory = cache_directory() / "programs" / _processor_tag()
    try:
        directory.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    lock = (
        directory / ".lockfile"
    )  # JAX opens it for each program, and would warn as often where it is another user's
    if not os.access(directory, os.W_OK | os.X_OK) or (
        lock.exists() and not os.access(lock, os.W_OK)
    ):
        return
    jax.config.update("jax_compilation_cache_dir", str(directory))
    for option, value in (
        ("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS),
        ("jax_compilation_cache_max_size", MAX_CACHE_BYTES),
    ):
        if option.upper() not in os.environ:
            jax.config.update(option, value)
    if _jax_started():  # and has found that there is no cache
        importlib.import_module(
            "jax.experimental.compilation_cache.compilation_cache"
        ).reset_cache()


def cache_directory() -> Path:
    """Where nermo_mjx keeps what it can make again: `$NERMO_MJX_CACHE`, or the platform's user cache directory."""
    if folder := os.environ.get("NERMO_MJX_CACHE"):
        return Path(folder).expanduser()
    if sys.platform == "darwin":
        base = Path("~/Library/Caches").expanduser()
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or Path("~/AppData/Local").expanduser())
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path("~/.cache").expanduser())
    return base / "nermo_mjx"


def processor_line(*beginnings: str) -> str:
    """The first line about the processor that begins so, on Linux; elsewhere Python's name of the processor."""
    with (
        contextlib.suppress(OSError, StopIteration),
        open("/proc/cpuinfo", errors="replace") as file,
    ):
        return next(line for line in file if line.lower().startswith(beginnings))
    return platform.processor()


def _processor_tag() -> str:
    """Names this kind of processor: compiled CPU code from a home directory shared with a newer one would not run."""
    digest = hashlib.sha256(
        " ".join(sorted(processor_line("flags", "features").split())).encode()
    ).hexdigest()
    return f"{platform.machine() or 'cpu'}-{digest[:8]}"
