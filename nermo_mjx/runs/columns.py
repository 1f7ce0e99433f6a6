"""Columns of a table, each with its unit, its meaning and its role."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa


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
        values = np.asarray(values)
        if values.dtype.kind in "fiu":
            values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
        self._arrays[name] = pa.array(values.tolist() if values.dtype.kind in "OU" else values, from_pandas=nulls)
        metadata = {"unit": unit, "description": description, "role": role}
        metadata |= {key: text for key, text in more.items() if text}
        self._fields.append(pa.field(name, self._arrays[name].type, metadata=metadata))

    def table(self, about: Mapping[str, Any]) -> pa.Table:
        """The table, and what to note in its schema's metadata."""
        metadata = {key: str(value) for key, value in about.items()}
        return pa.table(self._arrays, schema=pa.schema(self._fields, metadata=metadata))
