"""What is compared: two sets of runs, of two tables or of two values of a column in one."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa

from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.results import Results, SweepRecord, result_files
from nermo_mjx.sweep.structures import label_of
from nermo_mjx.sweep.table import columns_of

#: A directory of a sweep, or its table.
Source: TypeAlias = "str | os.PathLike[str] | pa.Table | Results"
Value: TypeAlias = "float | str"


@dataclasses.dataclass(frozen=True)
class Arm:
    """A set of runs.

    Attributes:
        name: as messages and tables call it.
        results: the table that holds them.
        rows: their places in it, (n,).
        keys: what may distinguish their variants, name -> (n,): the varied columns, and values fixed instead.
    """

    name: str
    results: Results
    rows: np.ndarray
    keys: Mapping[str, np.ndarray]

    def take(self, chosen: np.ndarray) -> Arm:
        """The runs at these places, or where a mask holds."""
        return dataclasses.replace(
            self, rows=self.rows[chosen], keys={name: values[chosen] for name, values in self.keys.items()}
        )

    def column(self, name: str) -> np.ndarray:
        """A column of these runs, (n,)."""
        return self.results.column(name)[self.rows]


def opened(source: Source) -> tuple[str, Results, SweepRecord | None, list[str]]:
    """The name of a table, the table, what is known of its sweep, and notes on missing rows.

    Raises:
        DirectoryError: it holds no results, or they cannot be read.
    """
    if isinstance(source, Results | pa.Table):
        return "table", source if isinstance(source, Results) else Results(source), None, []
    out = Path(source)
    if not out.is_dir():
        raise SpecError(f"{out}: {'this is a file, not a directory' if out.exists() else 'no such directory'}.")
    files = result_files(out)
    if not files:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    results, sweep, notes = Results(files), SweepRecord.of_directory(out), []
    if sweep is not None and results.rows < sweep.rows:
        notes.append(f"{out} is not complete: {results.rows:,} of {sweep.rows:,} runs.")
    return str(source), results, sweep, notes


def two_tables(base: Source, other: Source) -> tuple[list[Arm], list[str]]:
    """All runs of two tables, and notes on how their sweeps differ."""
    arms, notes, sweeps = [], [], []
    for source in (base, other):
        name, results, sweep, said = opened(source)
        arms.append(Arm(name, results, np.arange(results.rows), keys_of(results)))
        sweeps.append(sweep)
        notes += said
    if arms[0].name == arms[1].name:
        arms = [dataclasses.replace(arm, name=f"{arm.name} ({word})") for arm, word in zip(arms, "AB", strict=True)]
    names = {name: None for arm in arms for name in arm.keys}
    arms = [dataclasses.replace(arm, keys={**arm.keys, **_fixed(arm, sweep, [*names])})
            for arm, sweep in zip(arms, sweeps, strict=True)]  # fmt: skip
    first, second = sweeps
    if first is not None and second is not None:
        notes += [f"They differ in {each}." for each in _differences(first, second, names)]
    return arms, notes


def values_of(source: Source, by: str, base: Value | None) -> tuple[list[Arm], list[str]]:
    """The runs of one table, split by a varied column; the base's come first.

    Raises:
        ParameterError: there is no such column, or it has no such value, or one value only.
    """
    _, results, _, notes = opened(source)
    keys = keys_of(results)
    check_name(by, [*keys], "by")
    column = keys.pop(by)
    values = _in_order(column)
    if len(values) < 2:
        raise ParameterError(f"by is {by!r}, which has the one value {shown(values[0])}: nothing can be compared.")
    first = ("none" if "none" in values else values[0]) if base is None else value_among(base, values, "base")
    everyone = Arm("", results, np.arange(results.rows), keys)
    arms = [dataclasses.replace(everyone.take(column == value), name=shown(value))
            for value in (first, *(value for value in values if value != first))]  # fmt: skip
    return arms, notes


def keys_of(results: Results) -> dict[str, np.ndarray]:
    """The varied columns, (rows,) each; what a run does not have is NaN, or an empty text."""
    found = {}
    for name, values in results.columns(columns_of(results, "varied")):
        text = values.dtype == object
        found[name] = np.array(["" if each is None else str(each) for each in values]) if text else values.astype(float)
    return found


def absent(values: np.ndarray) -> np.ndarray:
    """Where a key has no value, (n,) bool."""
    return values == "" if values.dtype.kind == "U" else np.isnan(values)


def where(arm: Arm, chosen: Mapping[str, Value]) -> Arm:
    """The runs of which some columns have these values.

    Raises:
        ParameterError: there is no such column, or it has no such value.
    """
    for name, wanted in chosen.items():
        check_name(name, [*arm.keys], "where")
        value = value_among(wanted, _in_order(arm.keys[name]), f"where {name}")
        arm = arm.take(arm.keys[name] == value)
    return arm


def check_name(name: str, known: Sequence[str], option: str) -> None:
    """Refuse a column that is not varied."""
    if name not in known:
        raise ParameterError(f"{option} is {name!r}, which is not varied{did_you_mean(name, known)} "
                             f"Varied: {', '.join(known) or 'nothing'}.")  # fmt: skip


def value_among(wanted: Value, values: Sequence[Value], option: str) -> Value:
    """The requested value, as in the column; numbers may differ in their last digits."""
    for value in values:
        if isinstance(value, str) and str(wanted) == value:
            return value
        if not isinstance(value, str) and math.isclose(_as_number(wanted), value, rel_tol=1e-9, abs_tol=1e-12):
            return value
    listed = ", ".join(map(shown, values[:12])) + (f" and {len(values) - 12} more" if len(values) > 12 else "")
    hint = did_you_mean(str(wanted), list(map(shown, values)))
    raise ParameterError(f"{option} is {wanted!r}: the table has {listed}{hint or '.'}")


def shown(value: Value) -> str:
    """A value of a column as text: none, 0.8."""
    return value if isinstance(value, str) else f"{value:.10g}"


def _as_number(text: Value) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def _in_order(values: np.ndarray) -> list[Value]:
    """The different values of a column, in the order in which they come."""
    distinct, first = np.unique(values[~absent(values)], return_index=True)
    return distinct[np.argsort(first)].tolist()


def _fixed(arm: Arm, sweep: SweepRecord | None, names: Sequence[str]) -> dict[str, np.ndarray]:
    """Columns that only the other table varies: the value that this sweep has fixed, or none where it has no effect."""
    found: dict[str, np.ndarray] = {}
    for name in (name for name in names if name not in arm.keys):
        value: Any = None
        if sweep is not None and name not in columns_of(arm.results, "randomized"):
            value = sweep.parameters[name] if name in sweep.parameters else label_of(sweep.fields[name])
        found[name] = np.full(len(arm.rows), math.nan if value is None else value)
    return found


def _differences(base: SweepRecord, other: SweepRecord, varied: Mapping[str, Any]) -> list[str]:
    """What the two sweeps fix to different values, apart from what one of them varies."""
    first, second = ({**each.fields, **each.fields["set"]} for each in (base, other))
    apart = []
    for name in {**first, **second}:
        if name in ("set", *varied, *base.labelled, *other.labelled) or first.get(name) == second.get(name):
            continue
        values = ("the default" if each.get(name) is None else each[name] for each in (first, second))
        apart.append("{}: {} and {}".format(name, *values))
    return apart
