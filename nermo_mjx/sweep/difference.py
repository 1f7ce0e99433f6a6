"""In what a sweep differs from the one that a directory was begun with, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nermo_mjx.sweep.spec import Sweep

_NAMED = 3


def differences(begun: Sweep, wanted: Sweep) -> str:
    """The first fields that differ, each with both values: `seed is 0 there and 5 here`."""
    there, here = _fields(begun.resolved()), _fields(wanted.resolved())
    names = [name for name in {**there, **here} if there.get(name) != here.get(name)]
    names = [name for name in names if name not in ("chunk", "plots")]  # which rows there are does not depend on them
    shown = [f"{name} is {_text(there.get(name))} there and {_text(here.get(name))} here" for name in names[:_NAMED]]
    if not names:  # the same values, but another row 0
        return "the parameters under vary or randomize stand in another order"
    return "; ".join(shown) + (f"; and {len(names) - _NAMED} more fields" if len(names) > _NAMED else "")


def _fields(data: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Dotted names and values of all fields; lists are values."""
    fields: dict[str, Any] = {}
    for key, value in data.items():
        if isinstance(value, Mapping):
            fields |= _fields(value, f"{above}{key}.")
        else:
            fields[f"{above}{key}"] = value
    return fields


def _text(value: Any) -> str:
    text = "absent" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
