"""Traced programs on disk, so that the next process need not trace them again.

JAX's own cache spares the compiler, but it finds a program only after the program has been traced and lowered, which
takes longer than all else that a process does before its first step. Here a program, as `jax.export` writes it, is
found by what it is made from: the sources of this package, the versions of the libraries, the settings of JAX, the
devices, the shapes of the arguments, and what the caller says that it closes over. Where any of this cannot be told,
nothing is kept. The file belongs in a directory of the user's own, as the programs of JAX's cache do.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import pickle
import platform
import tempfile
from collections.abc import Callable, Sequence
from importlib import metadata
from pathlib import Path
from typing import Any, Final

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jax import export

from nermo_mjx import runtime

#: Programs that are kept in a directory; those that were used least recently go first.
MOST_FILES: Final = 200
#: Libraries that a program depends on, beside the sources of this package.
LIBRARIES: Final = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
#: Parts of the names of JAX's settings that say where and when it writes files, and not what it traces.
_FILE_SETTINGS: Final = ("cache", "dump")
_DIGEST_BYTES: Final = hashlib.sha256().digest_size


class KeptProgram:
    """A function under `jax.jit` whose traced form is kept for other processes."""

    def __init__(
        self,
        function: Callable[..., Any],
        closed_over: str | None,
        static: tuple[int, ...] = (),
        donated: tuple[int, ...] = (),
    ) -> None:
        """
        Args:
            function: of pytrees of arrays, jittable.
            closed_over: text that tells apart all that the function depends on, beside its arguments and the sources of
                this package; None where there is no such text, so that nothing may be kept.
            static: places of its static arguments, whose `repr` tells them apart.
            donated: places of the arguments whose memory the results may take.
        """
        self._function, self._closed_over, self._static, self._donated = function, closed_over, static, donated
        self._jitted = jax.jit(function, static_argnums=static, donate_argnums=donated)
        self._programs: dict[Any, Callable[..., Any]] = {}

    def __call__(self, *arguments: Any) -> Any:
        """As the jitted function; its program is loaded, or traced and stored, where the shapes are new."""
        leaves = jax.tree.leaves(arguments)
        directory = _directory()
        if directory is None or self._closed_over is None or any(isinstance(leaf, jax.core.Tracer) for leaf in leaves):
            return self._jitted(*arguments)
        traced, tree = jax.tree.flatten([a for place, a in enumerate(arguments) if place not in self._static])
        fixed = tuple(repr(arguments[place]) for place in self._static)
        called = (tree, tuple(map(_shape, traced)), fixed, _settings())
        if called not in self._programs:
            about = (self._function.__qualname__, self._closed_over, _environment(), called)
            path = directory / hashlib.sha256(repr(about).encode()).hexdigest()
            program = _load(path) or self._traced(path, arguments)
            if program is None:
                self._closed_over = None
                return self._jitted(*arguments)
            self._programs[called] = self._structured(program, arguments)
        return self._programs[called](*traced)

    def lower(self, *arguments: Any) -> Any:
        """As the jitted function's; made anew each time."""
        return self._jitted.lower(*arguments)

    def _traced(self, path: Path, arguments: Sequence[Any]) -> tuple[export.Exported, Any] | None:
        """The program of flat arrays and the structure of its results, put in the file; None if JAX cannot write it."""
        places = [place for place in range(len(arguments)) if place not in self._static]
        leaves, tree = jax.tree.flatten([arguments[place] for place in places])
        structure = None

        def flat(*leaves: Any) -> list[Any]:
            nonlocal structure
            given = dict(zip(places, jax.tree.unflatten(tree, leaves), strict=True))
            results = self._function(*(given.get(place, argument) for place, argument in enumerate(arguments)))
            structure = jax.tree.structure(results)
            return jax.tree.leaves(results)

        try:
            exported = export.export(jax.jit(flat))(*leaves)
        except (ValueError, NotImplementedError):  # it calls what is not sure to be there in another process
            return None
        # What cannot be stored can be used all the same.
        with contextlib.suppress(OSError, ValueError, NotImplementedError, pickle.PicklingError):
            _store(path, exported, structure)
        return exported, structure

    def _structured(self, program: tuple[export.Exported, Any], arguments: Sequence[Any]) -> Callable[..., Any]:
        """The program as a function of flat arrays that gives structured results."""
        exported, structure = program
        owners = [i for i, a in enumerate(arguments) if i not in self._static for _ in jax.tree.leaves(a)]
        donated = [place for place, owner in enumerate(owners) if owner in self._donated]
        flat = jax.jit(exported.call, donate_argnums=donated)
        return lambda *leaves: jax.tree.unflatten(structure, flat(*leaves))


def model_digest(model: mujoco.MjModel) -> str:
    """Hash of all numbers and names of a model."""
    buffer = np.empty(mujoco.mj_sizeModel(model), np.uint8)
    mujoco.mj_saveModel(model, None, buffer)
    return hashlib.sha256(buffer.tobytes()).hexdigest()


def is_ours(*things: object) -> bool:
    """Whether the classes of all things are this package's own, so that `source_digest` covers what they do."""
    ours = runtime.__name__.partition(".")[0]
    return all(type(thing).__module__.partition(".")[0] == ours for thing in things)


@functools.cache
def source_digest() -> str | None:
    """Hash of this package's sources; None if one is younger than this process, which may run an older version."""
    root, digest = Path(runtime.__file__).parent, hashlib.sha256()
    for path in sorted(root.rglob("*.py")):
        if path.stat().st_mtime > runtime.STARTED:
            return None
        digest.update(f"{path.relative_to(root).as_posix()}\0".encode() + path.read_bytes())
    return digest.hexdigest()


def _directory() -> Path | None:
    """Where programs are kept; None where JAX keeps none either, computes elsewhere, or the sources are not known."""
    config: Any = jax.config
    kept = config.jax_enable_compilation_cache and config.jax_compilation_cache_dir and not config.jax_default_device
    return runtime.cache_directory() / "programs" if kept and source_digest() is not None else None


def _shape(leaf: Any) -> tuple[Any, ...]:
    """What a program needs to know of an argument."""
    if isinstance(leaf, jax.Array):
        return leaf.shape, leaf.dtype, leaf.weak_type, leaf.sharding
    return np.shape(leaf), np.asarray(leaf).dtype, isinstance(leaf, bool | int | float | complex), None


def _settings() -> tuple[tuple[str, str], ...]:
    """JAX's settings in force."""
    values: dict[str, Any] = jax.config.values
    return tuple((name, repr(values[name])) for name in sorted(values) if not any(p in name for p in _FILE_SETTINGS))


@functools.cache
def _environment() -> tuple[Any, ...]:
    """All else that decides how a program is traced and lowered."""
    return (
        source_digest(),
        platform.python_version(),
        [metadata.version(name) for name in LIBRARIES],
        [(device.platform, device.device_kind) for device in jax.local_devices()],
        jax.local_devices()[0].client.platform_version,
    )


def _load(path: Path) -> tuple[export.Exported, Any] | None:
    """The program in a file, and the structure of its results; None if there is none that can be used."""
    try:
        content = path.read_bytes()
        payload = content[_DIGEST_BYTES:]
        if content[:_DIGEST_BYTES] != hashlib.sha256(payload).digest():
            return None
        program, structure = pickle.loads(payload)
        exported = export.deserialize(program)
        os.utime(path)
    except Exception:  # whatever is wrong with a file, its program is made anew
        return None
    _start_linear_algebra()
    return exported, structure


def _store(path: Path, exported: export.Exported, structure: Any) -> None:
    """Write a program, whole or not at all."""
    payload = pickle.dumps((exported.serialize(), structure))
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix="new-", delete=False) as file:
        file.write(hashlib.sha256(payload).digest() + payload)
    os.replace(file.name, path)
    used = {file: file.stat().st_mtime for file in path.parent.iterdir()}
    for old in sorted(used, key=used.__getitem__)[:-MOST_FILES]:
        old.unlink(missing_ok=True)


@functools.cache
def _start_linear_algebra() -> None:
    """Have JAX connect to LAPACK, which it does where it lowers a program, and not where it loads one."""
    jax.jit(jnp.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))
