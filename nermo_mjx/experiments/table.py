"""Conversion of an outcome to a Parquet table and back, and summaries of its cases over their repeats.

Roles of the columns: `case` (what tells the cases apart), `index` (repeat), `metric`, `status`, `code` (that made it).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa

from nermo_mjx.experiments.outcome import Column, Outcome
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import Recording
from nermo_mjx.runs.text import MISSING
from nermo_mjx.sweep.table import Columns, meta

REPEAT: Final = "repeat"
PROFILE: Final = "profile"
CODE: Final = "code"


def table_of(outcome: Outcome, about: Mapping[str, Any], code: str) -> pa.Table:
    """The table of an outcome, one row per world.

    Args:
        about: what to note in the schema's metadata.
        code: short name of the code that made it.
    """
    columns, cases = Columns(), case_columns(outcome)
    for name, values in outcome.columns.items():
        role = "case" if name in cases else {REPEAT: "index", "status": "status"}.get(name, "metric")
        column = outcome.about.get(name, Column("1", name.replace("_", " ")))
        columns.add(name, np.asarray(values), role, column.unit or "1", column.doc)
    rows = len(next(iter(outcome.columns.values())))
    columns.add(CODE, np.full(rows, code), CODE, "1", "the code that made the row, see run.json")
    return columns.table({"experiment": outcome.experiment, **about})


def outcome_of(table: pa.Table, recordings: Mapping[str, Recording]) -> Outcome:
    """The outcome that `table_of` converted to a table; its recordings are stored separately."""
    fields = [field for field in table.schema if meta(field)["role"] != CODE]
    # Texts become string arrays again instead of object arrays.
    columns = {field.name: np.array(table.column(field.name).to_pylist()) for field in fields}
    about = {field.name: Column(meta(field)["unit"], meta(field)["description"]) for field in fields}
    return Outcome(table.schema.metadata[b"experiment"].decode(), columns, about, recordings)


def case_columns(outcome: Outcome) -> list[str]:
    """Names of the columns that tell the cases apart, `profile` first: those before `repeat`."""
    names = list(outcome.columns)
    return names[: names.index(REPEAT)] if REPEAT in names else [PROFILE]


def status_counts(outcome: Outcome) -> dict[str, int]:
    """Number of successful worlds, or how the others ended; empty if the experiment has no status."""
    if "status" not in outcome.columns:
        return {}
    names, counts = np.unique(outcome.columns["status"], return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))


def case_count(outcome: Outcome) -> int:
    """Number of distinct cases, not counting profiles."""
    names = [name for name in case_columns(outcome) if name != PROFILE]
    return len(set(zip(*(outcome.columns[name].tolist() for name in names), strict=True))) if names else 1


@dataclasses.dataclass(frozen=True)
class CaseTable:
    """Cases of one profile for display: headings with units, their alignment, and one row of texts per case."""

    profile: str
    headings: list[str]
    sides: str
    rows: list[list[str]]


def case_tables(
    outcome: Outcome, metrics: Sequence[str], needs: Mapping[str, str] | None = None
) -> Iterator[CaseTable]:
    """A table of the cases of each profile, with the mean and standard deviation of `metrics` over their repeats.

    Args:
        needs: metric -> column that must be a number for the metric to be meaningful.
    """
    needs = needs or {}
    labels = [name for name in case_columns(outcome) if name != PROFILE]
    metrics = [name for name in metrics if name in outcome.columns]
    headings = [_heading(outcome, name) for name in labels] + [_heading(outcome, name, shown=True) for name in metrics]
    for profile in dict.fromkeys(outcome.columns[PROFILE].tolist()):
        rows = np.flatnonzero(outcome.where(profile=profile))
        cases: dict[tuple[Any, ...], list[int]] = {}
        for row in rows:
            cases.setdefault(tuple(outcome.columns[name][row].item() for name in labels), []).append(int(row))
        texts = [
            [_label(value) for value in case]
            + [_over_repeats(outcome, name, members, needs.get(name, "")) for name in metrics]
            for case, members in cases.items()
        ]
        yield CaseTable(profile, headings, "l" * len(labels) + "r" * len(metrics), texts)


def number(value: float, digits: int = 3) -> str:
    """A number with the given significant digits and no exponent; "–" where it is not finite, "0" below 5e-5."""
    if not math.isfinite(value):
        return MISSING
    if abs(value) < 5e-5:
        return "0"
    size = math.floor(math.log10(abs(value)))
    decimals = min(max(digits - 1 - size, 0), 7)
    return f"{round(value, decimals) + 0.0:,.{decimals}f}"


def _heading(outcome: Outcome, name: str, *, shown: bool = False) -> str:
    unit = outcome.about[name].unit if name in outcome.about else ""
    unit = _shown_unit(unit) if shown else unit
    text = name.replace("_", " ")
    return text if unit in ("", "1") else f"{text} [{unit}]"


def _shown_unit(unit: str) -> str:
    return shown("", unit, np.zeros(1)).unit


def _label(value: Any) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:g}" if isinstance(value, float) else str(value)


def _over_repeats(outcome: Outcome, name: str, rows: list[int], need: str) -> str:
    """Mean and spread of numbers, counts of Booleans, all distinct texts."""
    if need in outcome.columns and not np.isfinite(outcome.columns[need][rows]).any():
        return MISSING
    values = np.asarray(outcome.columns[name])[rows]
    if values.dtype == bool:
        return f"{int(values.sum())} of {len(values)}"
    if values.dtype.kind in "OU":
        return "; ".join(dict.fromkeys(filter(None, map(str, values.tolist())))) or MISSING
    quantity = shown(name, outcome.about[name].unit, values)
    good = quantity.values[np.isfinite(quantity.values)]
    if not len(good):
        return MISSING
    mean = float(good.mean())
    text = number(mean)
    # Values that do not depend on the start, such as theory, have no spread except rounding.
    if np.ptp(good) > 1e-6 * abs(mean):
        decimals = len(text.partition(".")[2])
        text += f" ± {good.std(ddof=1):.{decimals}f}"
    return text if len(good) == len(values) else f"{text} ({len(good)} of {len(values)})"
