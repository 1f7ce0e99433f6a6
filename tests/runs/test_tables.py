# Tests of docs/files.md
"""Result tables in other programs: each of the documented lines reads a sweep's and a tuning's directory."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import SPEC, FakeSimulator

from nermo_mjx.sweep import read_table, run_sweep

PAGE = Path(__file__).parents[2] / "docs" / "files.md"


@pytest.fixture(scope="module")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep's directory of several chunks, whose rows are not in order."""
    folder = tmp_path_factory.mktemp("tables")
    spec = SPEC | {"vary": {"frequency": [1.0, 0.5, 0.7], "stride": [0.5, 1.0]}}
    run_sweep(spec, folder, chunk=2, simulator=FakeSimulator())
    return folder


def documented(start: str) -> str:
    """The first statement of the page that begins so, with its indented lines and the closing brace."""
    statement = rf"^({re.escape(start)}.*(?:\n[ }}].*)*)$"
    return re.findall(statement, PAGE.read_text(), re.MULTILINE)[0]


@pytest.mark.extra
@pytest.mark.parametrize("package", ["pandas", "polars", "duckdb"])
def test_tables_open_in_one_line(package: str, out: Path) -> None:
    """As the page has it, with all rows and the same numbers."""
    module = pytest.importorskip(package)
    line = documented(f"{package}.").replace("DIR", str(out)).partition("  #")[0]
    loaded = eval(line, {package: module})
    frame = loaded.df() if package == "duckdb" else loaded
    table = read_table(out)
    order = np.argsort(np.asarray(frame["row"]))
    assert len(frame) == table.num_rows == 6
    for name in ("frequency", "stride", "speed"):
        np.testing.assert_array_equal(np.asarray(frame[name])[order], table.column(name).to_numpy())
    assert set(frame["status"]) == {"ok"}


@pytest.mark.extra
def test_the_best_rows_are_a_query_away(out: Path) -> None:
    """The documented query of DuckDB, over the files as they are."""
    duckdb = pytest.importorskip("duckdb")
    query = re.search(r'"(SELECT .* LIMIT \d+)"', PAGE.read_text())
    assert query is not None
    best = duckdb.sql(query[1].replace("DIR", str(out))).df()
    assert best["speed"].iloc[0] == read_table(out).column("speed").to_numpy().max()


def test_units_stand_in_the_columns_metadata(out: Path) -> None:
    """As the page reads them, from any chunk, with PyArrow alone."""
    line = documented("units = ").replace("DIR", str(out))
    scope: dict = {"pq": pq}
    exec(line, scope)
    units = scope["units"]
    assert units["frequency"] == "Hz"
    assert units["speed"] == "m/s"
    assert units["roll_std"] == "rad"
    assert set(units) - {"key"} == set(read_table(out).column_names)
