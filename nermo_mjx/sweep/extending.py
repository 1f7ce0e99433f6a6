"""Whether the sweep of a directory can be extended to another one, and how two sweeps differ."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from nermo_mjx.rollout.start import START_SPREAD
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.structures import STRUCTURES

#: Fields that determine the rows; all others are fixed.
_ROWS: Final = ("vary", "rows", "sample", "randomize.repeats")
#: Number of fields that a message names when two sweeps differ.
_NAMED: Final = 3


def fixed_differences(there: Sweep, here: Sweep) -> str:
    """How two sweeps differ apart from their rows, as `seed is 0 there and 5 here`; empty if they do not.

    What one of them fixes may be varied by the other.
    """
    free = {*there.labelled, *here.labelled}
    free |= {f"set.{name}" for name in (*there.varied, *here.varied)}
    free |= {f"randomize.{name}" for name in START_SPREAD}  # come with repeats
    if "physics" in free:
        free.add("timestep")
    names = _apart(there, here)
    return _sentence(there, here, [name for name in names if not _of_rows(name, free)])


def differences(there: Sweep, here: Sweep) -> str:
    """How two sweeps differ: the first fields, each with both values: `seed is 0 there and 5 here`."""
    # The same values, but another row 0.
    return _sentence(there, here, _apart(there, here)) or (
        "the parameters under vary or randomize stand in another order"
    )


def refusal(there: Sweep, here: Sweep) -> str:
    """Why a directory's sweep cannot be extended to another one, in words; empty if it can."""
    fixed = fixed_differences(there, here)
    if fixed:
        return f"{fixed}: what is not varied stays as it is"
    if there.sampler == here.sampler == "latin_hypercube" and there.samples != here.samples:
        return (
            f"a Latin hypercube of {there.samples} points is not part of one of {here.samples}: use a Sobol sample, "
            "which can be extended, or repeats"
        )
    return ""


def _of_rows(name: str, free: set[str]) -> bool:
    return name in free or name.split(".")[0] in free & set(STRUCTURES) or any(
        name == field or name.startswith(f"{field}.") for field in _ROWS
    )  # fmt: skip


def _apart(there: Sweep, here: Sweep) -> list[str]:
    first, second = _fields(there.decisive()), _fields(here.decisive())
    return [name for name in {**first, **second} if first.get(name) != second.get(name)]


def _sentence(there: Sweep, here: Sweep, names: list[str]) -> str:
    first, second = _fields(there.decisive()), _fields(here.decisive())
    shown = [f"{name} is {_text(first.get(name))} there and {_text(second.get(name))} here" for name in names[:_NAMED]]
    return "; ".join(shown) + (f"; and {len(names) - _NAMED} more fields" if len(names) > _NAMED else "")


def _fields(data: Mapping[str, Any], above: str = "") -> dict[str, Any]:
    """Dotted names and values of all fields; lists are values."""
    fields: dict[str, Any] = {}
    for key, value in data.items():
        fields |= _fields(value, f"{above}{key}.") if isinstance(value, Mapping) else {f"{above}{key}": value}
    return fields


def _text(value: Any) -> str:
    text = "absent" if value is None else f"{value:g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
