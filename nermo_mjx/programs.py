"""JAX programs whose tracing outlives the process: a program traced once is read from a file the next time.

JAX's own cache stores compiled executables, keyed by the whole program: a walk and its derivative take 10 to 25 s to
trace before they are found there. `Program` also stores the traced program (`jax.export`: StableHLO, a megabyte), keyed
by everything that determines it. The file contains no machine code: XLA compiles it, or JAX's cache has it compiled.
A process that traces a program also compiles it from the file's content, so that results are bit-identical.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.metadata
import logging
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import jax
from jax import export

from nermo_mjx.files import MOST_ARRAYS, read_bytes
from nermo_mjx.runtime import cache_directory, compiler_options

#: Largest total size of all files; the least recently used are removed.
MOST_BYTES: Final = 256 * 1024**2
_HEAD: Final = b"nermo-mjx program 1\n"
_SUFFIX: Final = ".program"
#: JAX settings that affect tracing.
_SETTINGS: Final = (
    "jax_enable_x64",
    "jax_default_matmul_precision",
    "jax_numpy_dtype_promotion",
    "jax_numpy_rank_promotion",
    "jax_default_prng_impl",
    "jax_threefry_partitionable",
    "jax_debug_nans",
    "jax_debug_infs",
    "jax_enable_checks",
)
_VERSIONS: Final = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


class Program:
    """A function like `jax.jit`'s, for arguments and results made of arrays in tuples, lists and dicts."""

    def __init__(self, function: Callable[..., Any], identity: str | None) -> None:
        """
        Args:
            function: pure.
            identity: all that determines what it computes, apart from this package's sources, the versions of JAX and
                MuJoCo, and the shapes of its arguments; None if unknown, as for user code: nothing is stored.
        """
        self._jitted = jax.jit(function, compiler_options=compiler_options())
        self._identity = identity
        self._compiled: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any) -> Any:
        if self._identity is None or _setting("jax_disable_jit"):
            return self._jitted(*arguments)
        structure = jax.tree.structure(arguments)
        shapes = tuple((leaf.shape, str(leaf.dtype)) for leaf in jax.tree.leaves(arguments))
        if (structure, shapes) not in self._compiled:
            self._compiled[structure, shapes] = self._made(arguments, f"{structure} {shapes}")
        return self._compiled[structure, shapes](*arguments)

    def _made(self, arguments: Any, shapes: str) -> Callable[..., Any]:
        """The compiled program for such arguments, from the cache or newly traced."""
        folder = _folder()
        if folder is None:
            return self._jitted
        path = folder / f"{_digest(self._identity, shapes)}{_SUFFIX}"
        kept = _read(path)
        if kept is None:
            try:
                kept = export.export(self._jitted)(*arguments)
                _write(path, bytes(kept.serialize()))
            # What this JAX version or platform cannot export.
            except (ImportError, NotImplementedError, ValueError) as refused:
                logging.getLogger(__name__).info("%s is not kept: %s", path.name, refused)
                return self._jitted
        # Compiled here, once: its results are committed to its device, and `jit` would recompile for such arguments.
        return jax.jit(kept.call, compiler_options=compiler_options()).lower(*arguments).compile()


def _folder() -> Path | None:
    """The cache directory; None if the user wants no cache, or it cannot be written."""
    if not _setting("jax_enable_compilation_cache") or os.environ.get("JAX_COMPILATION_CACHE_DIR") == "":
        return None
    folder = cache_directory() / "traced"
    with contextlib.suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
    return folder if os.access(folder, os.W_OK | os.X_OK) else None


def _digest(*identity: Any) -> str:
    """A key for what is traced here: other code, another version, setting or platform gives another key."""
    settings = [(name, str(_setting(name))) for name in _SETTINGS]
    found = (_sources(), _versions(), settings, jax.default_backend(), jax.device_count(), *identity)
    return hashlib.sha256(repr(found).encode()).hexdigest()[:32]


def _setting(name: str) -> Any:
    """The current value of a JAX setting; None if this JAX version has no such setting."""
    return getattr(jax.config, name, None)


@functools.cache
def _versions() -> tuple[str, ...]:
    return tuple(importlib.metadata.version(package) for package in _VERSIONS)


@functools.cache
def _sources() -> str:
    """Digest of all of this package's sources, at the first request for a program."""
    package, total = Path(__file__).parent, hashlib.blake2b(digest_size=16)
    for path in sorted(package.rglob("*.py")):
        total.update(f"{path.relative_to(package).as_posix()}\0".encode())
        total.update(path.read_bytes())
    return total.hexdigest()


def _read(path: Path) -> export.Exported | None:
    """The program of a file; None if there is none, or if it is damaged."""
    with contextlib.suppress(OSError):
        content = read_bytes(path, MOST_ARRAYS)
        head, content = content[: len(_HEAD) + 32], content[len(_HEAD) + 32 :]
        if head == _HEAD + hashlib.sha256(content).digest():
            with contextlib.suppress(Exception):  # any error from JAX about an unknown file
                found = export.deserialize(bytearray(content))
                os.utime(path)
                return found
    return None


def _write(path: Path, content: bytes) -> None:
    """Store a program atomically; a full or read-only disk only costs the time to trace it again."""
    with contextlib.suppress(OSError):
        with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
            try:
                file.write(_HEAD + hashlib.sha256(content).digest() + content)
                file.close()
                os.replace(file.name, path)
            except OSError:
                os.unlink(file.name)
                raise
        _prune(path.parent)


def _prune(folder: Path) -> None:
    """Remove the least recently used files until the rest fits."""
    files, total = [], 0
    for path in folder.iterdir():
        with contextlib.suppress(FileNotFoundError):  # another process has removed it
            files.append((path.stat().st_mtime, path.stat().st_size, path))
    for _, size, path in sorted(files, reverse=True):
        total += size
        if total > MOST_BYTES:
            path.unlink(missing_ok=True)
