"""Controllers by name: an object in a Python file or module, as a spec file or a command names it."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final

from nermo_mjx.control.protocol import REQUIRED
from nermo_mjx.robot.nearest import nearest
from nermo_mjx.robot.quantity import ParameterError

FORM: Final = "FILE.py:NAME or MODULE:NAME"


def load_controller(where: str) -> Any:
    """The controller that a text names; the same object as long as its file stays the same.

    Args:
        where: `FILE.py:NAME` or `MODULE:NAME`. The name is that of a controller, or of a class or function without
            arguments that gives one.

    Raises:
        ParameterError: there is no such file, module or name, it cannot be imported, or it is no controller.
    """
    source, name = _parts(where)
    module = _imported(where, *_content(where, source))
    found = getattr(module, name, None)
    if found is None:
        near = nearest(name, [each for each in vars(module) if not each.startswith("_")])
        hint = f"; did you mean {near!r}?" if near else "."
        raise ParameterError(f"controller is {where!r}: {source} has no {name!r}{hint}")
    controller = _made(where, found) if isinstance(found, (type, FunctionType)) else found
    check_form(controller)
    return controller


def controller_digest(where: str) -> str:
    """A hash of the controller's name and of the file that defines it; not of what that file imports.

    Raises:
        ParameterError: see `load_controller`.
    """
    source, name = _parts(where)
    _, content = _content(where, source)
    return hashlib.sha256(f"{name}\0".encode() + content).hexdigest()[:16]


def check_form(controller: Any) -> None:
    """Refuse what is no controller, see `ControllerLike`.

    Raises:
        ParameterError: with what it lacks.
    """
    missing = [name for name in REQUIRED if not hasattr(controller, name)]
    if missing:
        kind = type(controller).__name__
        raise ParameterError(
            f"controller is of type {kind}, which has no {' and no '.join(missing)}: a controller has "
            f"{', '.join(REQUIRED)}."
        )


def _parts(where: str) -> tuple[str, str]:
    source, colon, name = where.rpartition(":")
    if not colon or not source or not name.isidentifier():
        raise ParameterError(f"controller is {where!r}: expected {FORM}.")
    return source, name


def _content(where: str, source: str) -> tuple[str, bytes]:
    """The file of a module, and what is in it."""
    path = Path(source) if source.endswith(".py") else _file_of(where, source)
    try:
        return str(path.resolve()), path.read_bytes()
    except OSError as error:
        raise ParameterError(f"controller is {where!r}: {path} cannot be read ({error.strerror}).") from None


def _file_of(where: str, module: str) -> Path:
    try:
        spec = importlib.util.find_spec(module)
    except (ImportError, ValueError):
        spec = None
    if spec is None or spec.origin is None:
        raise ParameterError(f"controller is {where!r}: there is no module {module!r} here; expected {FORM}.")
    return Path(spec.origin)


@functools.lru_cache(maxsize=32)
def _imported(where: str, path: str, content: bytes) -> ModuleType:
    """The module; a file is run once for each content."""
    source, _ = _parts(where)
    try:
        if not source.endswith(".py"):
            return importlib.import_module(source)
        name = f"nermo_mjx_controller_{hashlib.sha256(path.encode() + content).hexdigest()[:16]}"
        module = ModuleType(name)
        module.__file__ = path
        sys.modules[name] = module  # dataclasses look their module up
        exec(compile(content, path, "exec"), module.__dict__)
        return module
    except Exception as error:
        raise ParameterError(
            f"controller is {where!r}: it cannot be imported ({type(error).__name__}: {error})."
        ) from None


@functools.lru_cache(maxsize=32)
def _made(where: str, maker: Any) -> Any:
    try:
        return maker()
    except TypeError as error:
        raise ParameterError(f"controller is {where!r}: it cannot be made without arguments ({error}).") from None
