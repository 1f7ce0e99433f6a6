"""Names of which one is allowed, and suggestions for misspelled ones."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from nermo_mjx.robot.quantity import ParameterError


def nearest(name: str, allowed: Iterable[str]) -> str | None:
    """The allowed name closest to `name`, or the one that ends with it (`amplitude`: `spine.amplitude`), or None."""
    names = list(allowed)
    found = difflib.get_close_matches(name, names, n=1)
    found += [full for full in names if full.rpartition(".")[2] == name.rpartition(".")[2]]
    return found[0] if found else None


def did_you_mean(name: str, allowed: Iterable[str]) -> str:
    """`; did you mean 'x'?` for the nearest allowed name, or a full stop where none is near."""
    found = nearest(name, allowed)
    return f"; did you mean {found!r}?" if found else "."


def choice(field: str, name: str, options: Iterable[str]) -> str:
    """`name` if it is one of `options`.

    Raises:
        ParameterError: it is not; the message names the field, the value, the nearest option and all of them.
    """
    names = list(options)
    if name in names:
        return name
    near = nearest(str(name), names)
    hint = f"did you mean {near!r}? " if near else ""
    allowed = ", ".join(names) if len(names) <= 12 else f"{', '.join(names[:4])}, ... ({len(names)} names)"
    raise ParameterError(f"{field} is {name!r}: {hint}allowed is one of {allowed}.")
