"""The user's Python files and modules, whose objects spec files and commands can name."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from nermo_mjx.robot.nearest import did_you_mean
from nermo_mjx.robot.quantity import ParameterError


def content_of_source(subject: str, source: str, form: str) -> tuple[str, bytes]:
    """The file of a source, and its content.

    Args:
        subject: the beginning of messages: `controller is 'bound.py:Bound'`.
        source: `FILE.py` or the name of a module.
        form: the expected form, for messages.

    Raises:
        ParameterError: the file or module does not exist or cannot be read.
    """
    path = Path(source) if source.endswith(".py") else _file_of(subject, source, form)
    try:
        return str(path.resolve()), path.read_bytes()
    except OSError as error:
        raise ParameterError(f"{subject}: {path} cannot be read ({error.strerror}).") from None


def module_of(subject: str, source: str, form: str) -> ModuleType:
    """The module of a source; a file is executed once for each version of its content. The arguments are those of
    `content_of_source`.

    Raises:
        ParameterError: see `content_of_source`; or it cannot be imported.
    """
    path, content = content_of_source(subject, source, form)
    try:
        return _imported(source, path, content)
    except Exception as error:
        raise ParameterError(f"{subject}: it cannot be imported ({type(error).__name__}: {error}).") from None


def no_such_name(subject: str, source: str, name: str, names: list[str]) -> ParameterError:
    """The error for a name that a source does not have, with its closest existing name."""
    return ParameterError(f"{subject}: {source} has no {name!r}{did_you_mean(name, names)}")


def _file_of(subject: str, module: str, form: str) -> Path:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    if spec is None or spec.origin is None:
        raise ParameterError(f"{subject}: there is no module {module!r} here; expected {form}.")
    return Path(spec.origin)


@functools.lru_cache(maxsize=32)
def _imported(source: str, path: str, content: bytes) -> ModuleType:
    if not source.endswith(".py"):
        return importlib.import_module(source)
    name = f"nermo_mjx_own_{hashlib.sha256(path.encode() + content).hexdigest()[:16]}"
    module = ModuleType(name)
    module.__file__ = path
    sys.modules[name] = module  # dataclasses look their module up
    exec(compile(content, path, "exec"), module.__dict__)
    return module
