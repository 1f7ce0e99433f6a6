"""Controllers by name: an object in a Python file or module, named in a spec file or a command."""

from __future__ import annotations

import functools
import hashlib
import importlib
import importlib.util
import sys
from contextvars import ContextVar
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final

from nermo_mjx.control.protocol import REQUIRED
from nermo_mjx.robot.quantity import ParameterError, did_you_mean

# ---
# The user's Python files and modules, whose objects spec files and commands can name.


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


#: Whether files and modules that are named may be run: what only reads a directory runs none of its code.
RUNS_CODE: ContextVar[bool] = ContextVar("RUNS_CODE", default=True)


def module_of(subject: str, source: str, form: str) -> ModuleType:
    """The module of a source; a file is executed once for each version of its content. The arguments are those of
    `content_of_source`.

    Raises:
        ParameterError: see `content_of_source`; or it cannot be imported, or nothing may be run here.
    """
    if not RUNS_CODE.get():
        raise ParameterError(f"{subject}: it is code, which a command that only reads does not run.")
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


FORM: Final = "FILE.py:NAME, MODULE:NAME or FILE.npz"


def load_controller(where: str) -> Any:
    """The controller that a text names; the same object as long as its file does not change.

    Args:
        where: `FILE.py:NAME` or `MODULE:NAME`, the name being that of a controller, or of a class or function that
            returns one when called without arguments; or `FILE.npz`, a policy from `nermo-mjx train`.

    Raises:
        ParameterError: the file, module or name does not exist, it cannot be imported, or it is not a controller.
    """
    if is_data(where):
        # By name: a policy belongs to a room above this one, which only policies need.
        return importlib.import_module("nermo_mjx.learn.policy").load_policy(where)
    source, name = _parts(where)
    module = module_of(f"controller is {where!r}", source, FORM)
    found = getattr(module, name, None)
    if found is None:
        public = [each for each in vars(module) if not each.startswith("_")]
        raise no_such_name(f"controller is {where!r}", source, name, public)
    controller = _made(where, found) if isinstance(found, (type, FunctionType)) else found
    check_form(controller)
    return controller


def controller_digest(where: str) -> str:
    """A hash of the controller's name, if it has one, and of the file that defines it; not of what that file imports.

    Raises:
        ParameterError: see `load_controller`.
    """
    if is_data(where):
        load_controller(where)
        return hashlib.sha256(Path(where).read_bytes()).hexdigest()[:16]
    source, name = _parts(where)
    _, content = content_of_source(f"controller is {where!r}", source, FORM)
    return hashlib.sha256(f"{name}\0".encode() + content).hexdigest()[:16]


def is_data(where: str) -> bool:
    """Whether a text names a file that holds a controller as data instead of code."""
    return Path(where).suffix == ".npz"


def check_form(controller: Any) -> None:
    """Reject objects that are not controllers, see `ControllerLike`.

    Raises:
        ParameterError: the message names what is missing.
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


@functools.lru_cache(maxsize=32)
def _made(where: str, maker: Any) -> Any:
    try:
        return maker()
    except TypeError as error:
        raise ParameterError(f"controller is {where!r}: it cannot be made without arguments ({error}).") from None
