"""Public names that are imported on first use, and former names that still work for one minor version."""

from __future__ import annotations

import ast
import sys
import warnings
from pkgutil import resolve_name
from typing import Any


def lazy_names(package: str, removed: dict[str, str] | None = None, **former: str) -> Any:
    """Return `__getattr__`, `__dir__` and `__all__` of a package that imports its public names on first use.

    The public names are those that the source of the package imports as themselves, `from MODULE import NAME as NAME`,
    below `if TYPE_CHECKING:`. A type checker reads the same lines, so that there is one list.

    Args:
        package: Name of the package, whose source must be readable.
        former: Former name of an object -> `MODULE:NAME`, where the object is now.
        removed: Name of an earlier release -> what replaces it; the name raises an `ImportError` with this text.

    >>> get, _, names = lazy_names("nermo_mjx.dynamics", advance="nermo_mjx.dynamics:step")
    >>> "step" in names, "advance" in names, get("advance") is get("step")
    (True, False, True)
    """
    source = sys.modules[package].__spec__.loader.get_source(package)  # type: ignore[union-attr]
    places = {
        # A name from the package itself is a module.
        alias.name: f"{package}.{alias.name}:"
        if line.module == package
        else f"{line.module}:{alias.name}"
        for line in ast.walk(ast.parse(source))
        if isinstance(line, ast.ImportFrom)
        for alias in line.names
        if alias.asname == alias.name
    }

    def get(name: str) -> Any:
        if name in former:
            warn_former(f"{package}.{name}", former[name].replace(":", "."), DeprecationWarning)
            return resolve_name(former[name])
        if (
            removed and name in removed
        ):  # of an AttributeError, `from PACKAGE import NAME` would hide the message
            raise ImportError(f"{package}.{name} was removed: {removed[name]}.")
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return resolve_name(places[name])

    return get, places.keys, tuple(places)


def warn_former(former: str, present: str, kind: type[Warning]) -> None:
    """Warn the caller's caller that a former name is used, which the next minor version will not accept.

    Args:
        former: Former name.
        present: Name that replaces it.
        kind: `DeprecationWarning` for a name in Python, `FutureWarning` for a name in a file, which users write.

    >>> with warnings.catch_warnings(record=True) as caught:
    ...     warnings.simplefilter("always")
    ...     warn_former("nermo_mjx.walk", "nermo_mjx.run", DeprecationWarning)
    >>> print(caught[0].message)
    nermo_mjx.walk is a former name, which the next minor version will not accept: use nermo_mjx.run.
    """
    warnings.warn(
        f"{former} is a former name, which the next minor version will not accept: use {present}.",
        kind,
        stacklevel=3,
    )
