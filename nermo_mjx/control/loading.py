"""Controllers by name: an object in a Python file or module, named in a spec file or a command."""

from __future__ import annotations

import functools
import hashlib
import importlib
from pathlib import Path
from types import FunctionType
from typing import Any, Final

from nermo_mjx.control.protocol import REQUIRED
from nermo_mjx.robot.own_code import content_of_source, module_of, no_such_name
from nermo_mjx.robot.quantity import ParameterError

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
