"""Controllers by name: an object in a Python file or module, named in a spec file or a command."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import importlib.util
import inspect
import sys
import traceback
from collections.abc import Iterator
from contextvars import ContextVar
from pathlib import Path
from types import FunctionType, ModuleType
from typing import Any, Final

import jax
import numpy as np

from nermo_mjx.control.protocol import REQUIRED
from nermo_mjx.robot.parameters import Sensors
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
    with told(f"{subject}: it cannot be imported"):
        return _imported(source, path, content)


#: Errors of functions that cannot be traced.
_NOT_JITTABLE: Final = (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError,
                        jax.errors.TracerBoolConversionError, jax.errors.TracerIntegerConversionError)  # fmt: skip
#: Packages whose lines are not the user's, where an error arises.
_OTHERS: Final = ("jax", "jaxlib", "numpy", "nermo_mjx", "importlib", "contextlib", "_sitebuiltins")


@contextlib.contextmanager
def told(subject: str) -> Iterator[None]:
    """Turn any error of the user's code into one sentence: the subject, the user's file and line, and what is wrong.

    Raises:
        ParameterError: instead of the error.
    """
    try:
        yield
    except ParameterError:
        raise
    except (Exception, SystemExit) as error:
        frames = [
            f"{Path(frame.f_code.co_filename).name}:{line}"
            for frame, line in traceback.walk_tb(error.__traceback__)
            if frame.f_globals.get("__name__", "").partition(".")[0] not in _OTHERS
        ]
        place = f" at {frames[-1]}" if frames else ""
        if isinstance(error, _NOT_JITTABLE):
            raise ParameterError(
                f"{subject}{place}: it cannot be compiled, as it branches on readings or other traced values, or makes "
                "NumPy's numbers of them; use jax.numpy, and jnp.where instead of if."
            ) from None
        hint, wrong = "", (str(error).strip().splitlines() or [""])[0].rstrip(".")[:200]
        if isinstance(error, AttributeError) and isinstance(error.obj, Sensors):
            known = [field.name for field in dataclasses.fields(Sensors)]
            hint = f"{did_you_mean(str(error.name), known)} Sensors are {', '.join(known)}"
        raise ParameterError(f"{subject}{place}: {type(error).__name__}: {wrong}{hint}.") from None


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
        ParameterError: the message names what is missing, or what of it is wrong.
    """
    kind = type(controller).__name__
    with told(f"controller is of type {kind}, which fails"):
        missing = [name for name in REQUIRED if not hasattr(controller, name)]
        if missing:
            raise ParameterError(
                f"controller is of type {kind}, which has no {' and no '.join(missing)}: a controller has "
                f"{', '.join(REQUIRED)}."
            )
        dt, leaves = controller.dt, jax.tree.leaves(controller.parameters)
    if not isinstance(dt, (int, float, np.number)) or not 0.0 < dt < np.inf:
        raise ParameterError(f"controller has dt {dt!r}: expected the seconds of a tick, a finite number above 0.")
    for leaf in leaves:
        if np.asarray(leaf).dtype.kind not in "fiub":
            raise ParameterError(
                f"controller has parameters with {leaf!r}: expected a pytree of numbers, such as an object of a class "
                "under nermo_mjx.parameter_tree."
            )


def named_place(controller: Any, name: str) -> str:
    """A function of a controller and where it stands, for messages: `controller has update (bound.py:37)`."""
    code = getattr(inspect.unwrap(getattr(controller, name)), "__code__", None)
    place = "" if code is None else f" ({Path(code.co_filename).name}:{code.co_firstlineno})"
    return f"controller has {name}{place}"


def _parts(where: str) -> tuple[str, str]:
    source, colon, name = where.rpartition(":")
    if not colon or not source or not name.isidentifier():
        raise ParameterError(f"controller is {where!r}: expected {FORM}.")
    return source, name


@functools.lru_cache(maxsize=32)
def _made(where: str, maker: Any) -> Any:
    with told(f"controller is {where!r}: it cannot be made without arguments"):
        return maker()
