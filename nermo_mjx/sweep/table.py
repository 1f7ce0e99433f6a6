"""The result table: one row per run, and in each column's metadata its unit, its meaning and its role.

Roles: `index` (row, variant, repeat, seed, body), `varied`, `randomized`, `metric`, `status`, `code`. A varied
structure is a column of texts whose `scale` is `structure`; a varied parameter is null where nothing reads it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pyarrow as pa

from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.structures import about_structure

_INDEX = {
    "row": "position of the run in the sweep",
    "variant": "index of the variant",
    "repeat": "index of the repeat within its variant",
    "seed": "seed of the row's random draws",
}


class Columns:
    """Collects the columns of a table; each field's metadata has its unit, its description and its role."""

    def __init__(self) -> None:
        self._arrays: dict[str, pa.Array] = {}
        self._fields: list[pa.Field] = []

    def add(
        self,
        name: str,
        values: np.ndarray,
        role: str,
        unit: str,
        description: str,
        *,
        nulls: bool = False,
        **more: str | None,
    ) -> None:
        """Add a column of (n,) values; with `nulls` a NaN is one."""
        self._arrays[name] = pa.array(_plain(values), from_pandas=nulls)
        metadata = {"unit": unit, "description": description, "role": role}
        metadata |= {key: text for key, text in more.items() if text}
        self._fields.append(pa.field(name, self._arrays[name].type, metadata=metadata))

    def table(self, about: Mapping[str, Any]) -> pa.Table:
        """The table, and what to note in its schema's metadata."""
        metadata = {key: str(value) for key, value in about.items()}
        return pa.table(self._arrays, schema=pa.schema(self._fields, metadata=metadata))


def chunk_table(
    sweep: Sweep,
    rows: Rows,
    index: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    status: np.ndarray,
    code: str | np.ndarray,
    about: Mapping[str, Any],
) -> pa.Table:
    """The table of one chunk.

    Args:
        rows: the runs of the chunk, and `index` their positions in the sweep, (n,).
        metrics: name -> (n,) results; status: (n,) texts, "ok" where a run went well.
        code: short name of the code that made them, or (n,) names.
        about: what to note about the chunk in the schema's metadata (engine, steps, ...).
    """
    columns = Columns()
    parameters = sweep.parameters
    forms = {axis.name: axis.form for axis in sweep.axes} | {draw.name: draw.form for draw in sweep.draws}
    forms |= dict.fromkeys(sweep.body_parameters, "loguniform")  # the prior of the identification
    forms |= dict.fromkeys(sweep.varied if sweep.rows is not None else (), "values")
    for name, values in zip(_INDEX, (index, rows.variant, rows.repeat, rows.seed), strict=True):
        columns.add(name, values, "index", "1", _INDEX[name])
    if rows.body is not None:
        columns.add("body", rows.body, "index", "1", "body of the identified ensemble; 0 is the default one")
    for name in sweep.labelled:
        labels = np.array([each.labels[name] for each in sweep.structures], object)[rows.structure]
        columns.add(name, labels, "varied", "1", about_structure(name), scale="structure")
    for name, values in rows.values.items():
        role = "varied" if name in sweep.varied else "randomized"
        scale = "log" if forms[name].startswith("log") else "linear"
        columns.add(name, values, role, parameters[name].unit, parameters[name].doc, nulls=True, scale=scale)
    for name, metric in sweep.metrics.items():
        if name in metrics:
            columns.add(name, metrics[name], "metric", metric.unit, metric.doc, better=metric.better)
    columns.add("status", np.asarray(status), "status", "1", "ok, or how the run ended")
    codes = np.broadcast_to(np.asarray(code, object), len(index))
    columns.add("code", codes, "code", "1", "which code made the row, as run.json names it")
    sampler = "grid" if sweep.is_grid else sweep.sampler
    pairs = {"second_order": "true"} if sweep.second_order else {}
    return columns.table({"sweep": sweep.digest(), "sampler": sampler, **pairs, **about})


def joined(parts: Sequence[pa.Table], index: np.ndarray) -> pa.Table:
    """One table of several, its rows in the order of their numbers in `index`; what one does not know is null."""
    table = pa.concat_tables(parts, promote_options="default")
    order = np.argsort(index, kind="stable")
    place = np.empty(len(index), int)
    place[order] = np.argsort(table.column("row").to_numpy(), kind="stable")
    return table.take(place)


def columns_of(table: Any, *roles: str) -> list[str]:
    """Names of the columns with one of the roles, in order; of whatever has a schema."""
    return [field.name for field in table.schema if meta(field)["role"] in roles]


def labelled(table: Any) -> list[str]:
    """Names of the varied structures, whose columns are texts."""
    return [field.name for field in table.schema if meta(field).get("scale") == "structure"]


def meta(field: pa.Field) -> dict[str, str]:
    """A column's metadata as text: unit, description, role."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def _plain(values: np.ndarray) -> Any:
    """Floats as float64, whole numbers as int64, the rest (truth values, texts) as it is."""
    values = np.asarray(values)
    if np.issubdtype(values.dtype, np.floating):
        return values.astype(np.float64)
    if np.issubdtype(values.dtype, np.integer):
        return values.astype(np.int64)
    return values.tolist() if values.dtype.kind in "OU" else values
