"""Stored reports on finished tables: a table in one file, or a directory of table, JSON and figures."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
from pyarrow import csv

from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.directory import RunDirectory, read_record
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, parquet_table, replace_file
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.status import Status
from nermo_mjx.runs.text import to_json
from nermo_mjx.runs.written import Written

#: Endings of a table in one file.
TABLES: Final = (".parquet", ".csv")


def write_report(
    out: Path, kind: str, table: pa.Table, about: Mapping[str, Any], figures: Figures
) -> tuple[list[Path], str]:
    """Write a report, and return its files, and a message about files that were in the way, empty if there were none.

    Args:
        out: FILE.csv or FILE.parquet for the table alone, else a directory: KIND.parquet, KIND.json and plots/.
        kind: of the directory: "comparison" or "sensitivity".
        table: what was found.
        about: the same for JSON.
        figures: of it.

    Raises:
        ParameterError: the file has another ending.
        DirectoryError: it cannot be written, or holds something else.
    """
    if out.suffix in TABLES:
        with clear_errors(out.parent):
            out.parent.mkdir(parents=True, exist_ok=True)
            replace_file(out, parquet_bytes(table) if out.suffix == ".parquet" else _csv(table))
        return [out], ""
    if out.is_file() or (out.suffix and not out.is_dir()):
        raise ParameterError(f"out is {str(out)!r}: allowed is a directory, FILE.parquet or FILE.csv.")
    with RunDirectory(out, kind) as held, Written(held) as written:
        paths = [held.out / f"{kind}.parquet", held.out / f"{kind}.json"]
        for path, content in zip(paths, (parquet_bytes(table), to_json(about)), strict=True):
            written.write(path, content)
        paths += write_figures(figures, held.out / "plots", written.write)
        held.note_session(session())
    return paths, written.sentence()


def report_table(out: Path, kind: str) -> pa.Table:
    """The table of a report's directory.

    Raises:
        DirectoryError: it is absent or damaged.
    """
    table = parquet_table(out / f"{kind}.parquet")
    if table is None:
        raise DirectoryError(f"{out / kind}.parquet is absent or damaged: run nermo-mjx {_COMMANDS[kind]} again.")
    return table


def status(out: Path) -> Status:
    """The contents of a report's directory."""
    kind = str(read_record(out).get("kind"))
    table = parquet_table(out / f"{kind}.parquet")
    rows = 0 if table is None else table.num_rows
    return Status("lines", rows, rows, bool(rows), f"nermo-mjx plot {out}")


#: Which command makes a kind of report.
_COMMANDS: Final = {"comparison": "compare", "sensitivity": "sensitivity"}


def _csv(table: pa.Table) -> bytes:
    stream = io.BytesIO()
    csv.write_csv(table, stream)
    return stream.getvalue()
