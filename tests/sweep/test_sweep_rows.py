# Tests of sweep/structures.py, sweep/spec.py
"""Sweeps whose variants are given one by one: in the file, as CSV, or as a table of results."""

from __future__ import annotations

import datetime
import decimal
import shutil
import time
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from command import call, refused
from fakes.sweep_fake import SPEC, FakeSimulator, part_of, speed

from nermo_mjx.files import FileError
from nermo_mjx.specs.reading import read_mapping
from nermo_mjx.sweep import SpecError, Sweep, read_table, run_sweep, simulating
from nermo_mjx.sweep.replay import find_row
from nermo_mjx.sweep.structures import read_row_table

LIST = [
    {"gait": "trot", "spine": "none", "frequency": 0.8},
    {"gait": "lateral_walk", "spine": "stride_extension", "frequency": 0.6, "spine.amplitude": 0.3},
    {"gait": "trot", "spine": "stride_extension", "frequency": 1.1, "spine.amplitude": 0.2},
    {"gait": "trot", "spine": "stride_extension", "frequency": 0.9},
]
CSV = """gait,spine,frequency,spine.amplitude
trot,none,0.8,
lateral_walk,stride_extension,0.6,0.3

trot, stride_extension, 1.1, 0.2
trot,stride_extension,0.9,
"""
EXPECTED = {
    "gait": ["trot", "lateral_walk", "trot", "trot"],
    "spine": ["none", *["stride_extension"] * 3],
    "frequency": [0.8, 0.6, 1.1, 0.9],
    "spine.amplitude": [None, 0.3, 0.2, 0.25],
}


@pytest.fixture
def expected():
    """With the default where a structure reads what a row leaves out."""
    default = Sweep.from_dict(
        {"spine": "stride_extension", "vary": {"frequency": [1.0]}}
    ).setup.defaults()
    return EXPECTED | {"spine.amplitude": [None, 0.3, 0.2, default["spine.amplitude"]]}


def kept(table, *names):
    return {name: table.column(name).to_pylist() for name in names or EXPECTED}


def test_a_list_a_csv_and_a_parquet_file_say_the_same(tmp_path, expected):
    """In the order given; the paths count from the sweep's file."""
    (tmp_path / "design.csv").write_text(CSV)
    nulls = {name: [row.get(name) for row in LIST] for name in EXPECTED}
    pq.write_table(pa.table(nulls), tmp_path / "design.parquet")
    listed = run_sweep(
        {"rows": LIST, "plots": False}, tmp_path / "list", simulator=FakeSimulator()
    ).table
    assert kept(listed) == expected
    for file in ("design.csv", "design.parquet"):
        (tmp_path / "sweep.yaml").write_text(f"rows: {file}\nplots: false\n")
        table = run_sweep(
            tmp_path / "sweep.yaml", tmp_path / file[-3:], simulator=FakeSimulator()
        ).table
        assert table.equals(listed)


def test_the_directory_needs_the_file_no_more(tmp_path, expected):
    """Its rows are copied into it: it can be moved, resumed and replayed, and rows can be added."""
    (tmp_path / "design.csv").write_text(CSV)
    out = tmp_path / "out"
    run_sweep(
        {"rows": str(tmp_path / "design.csv"), "plots": False},
        out,
        chunk=1,
        simulator=FakeSimulator(),
    )
    (tmp_path / "design.csv").unlink()
    part_of(out, 1).unlink()
    moved = tmp_path / "moved"
    shutil.move(out, moved)
    assert find_row(moved, 3).values["spine.amplitude"] == expected["spine.amplitude"][3]
    assert kept(run_sweep(moved / "sweep.yaml", moved, simulator=FakeSimulator()).table) == expected
    text = Sweep.from_directory(moved)
    assert Sweep.from_dict(text.resolved()) == text


def test_a_pareto_front_again_with_repeats_by_the_command(tmp_path):
    """A filtered table of results, whose columns know what they are: varied ones count, all else is passed over."""
    spec = SPEC | {"randomize": {"repeats": 2, "contact.friction": {"uniform": [1, 2]}}}
    run_sweep(spec, tmp_path / "grid", simulator=FakeSimulator())
    table = read_table(tmp_path / "grid")
    pq.write_table(
        table.filter(pc.greater(table.column("speed"), 0.125)), tmp_path / "best.parquet"
    )
    named = kept(table, "frequency", "spine.amplitude", "spine.phase", "speed")
    fast = {row for row in zip(*named.values(), strict=True) if row[-1] > 0.125}
    sweep = Sweep.from_rows(tmp_path / "best.parquet", tmp_path / "grid" / "sweep.yaml")
    assert sweep.repeats == 2
    assert sweep.variants == len({row[:3] for row in fast}) > 1
    assert sweep.setup.spine == "stride_extension"
    words = ("--rows", tmp_path / "best.parquet", "--out", tmp_path / "out", "--engine", "steam")
    # The engine's name is checked; the rows are run below.
    assert call("sweep", tmp_path / "grid" / "sweep.yaml", *words).exit_code == 2
    result = run_sweep(sweep, tmp_path / "out", simulator=FakeSimulator())
    assert result.rows == 2 * sweep.variants


def test_the_command_takes_rows_without_a_file(tmp_path, monkeypatch):
    """The defaults hold for all else."""
    monkeypatch.setattr(simulating, "Simulator", lambda setup, engine: FakeSimulator(engine=engine))
    (tmp_path / "two.csv").write_text("frequency,contact.friction\n0.8,1.2\n0.6,1.0\n")
    result = call(
        "sweep",
        "--rows",
        tmp_path / "two.csv",
        "--out",
        tmp_path / "out",
        "--engine",
        "c",
        "--quiet",
    )
    assert result.exit_code == 0, result.stderr
    table = read_table(tmp_path / "out")
    assert kept(table, "frequency", "contact.friction") == {
        "frequency": [0.8, 0.6],
        "contact.friction": [1.2, 1.0],
    }


def test_rows_of_every_combination_are_a_grid(tmp_path):
    """Its figures are those of one."""
    rows = [{"frequency": f, "spine.amplitude": a} for a in (0.0, 0.2) for f in (0.5, 0.8)]
    base = {"spine": "stride_extension", "plots": False}
    grid = run_sweep(base | {"rows": rows}, tmp_path / "a", simulator=FakeSimulator())
    assert grid.table.schema.metadata[b"sampler"] == b"grid"
    assert [entry["value"] for entry in grid.summary["marginal_means"]["frequency"]] == [0.5, 0.8]
    listed = run_sweep(base | {"rows": rows[:3]}, tmp_path / "b", simulator=FakeSimulator())
    assert listed.table.schema.metadata[b"sampler"] == b"rows"
    expected = speed(np.array([0.5, 0.8, 0.5]), np.array([0, 0, 0.2]))
    np.testing.assert_allclose(listed.table.column("speed").to_numpy(), expected, rtol=1e-6)


#: A CSV file, and what is said of it.
WRONG = {
    "unknown column": ("frequenzy\n0.8\n", "rows.csv:1: field 'frequenzy' is not a parameter"),
    "nearest column": ("frequenzy\n0.8\n", "did you mean 'frequency'?"),
    "misspelt structure": ("gat,frequency\ntrt,0.8\n", "did you mean 'gait'?"),
    "results": (
        "frequency,roll_std\n0.8,0.1\n",
        "'roll_std' is a column of results, and the file does not say which",
    ),
    "text": (
        "frequency\n0.8\nfast\n",
        "rows.csv:3: field 'frequency' is the text 'fast': expected a number",
    ),
    "range": (
        "frequency,stride\n0.8,1\n9,1\n",
        "rows.csv:3: field 'frequency' is 9: allowed is [0.001, 5] Hz",
    ),
    "unknown gait": ("gait,frequency\ntrt,0.8\ntrott,0.8\n", "rows.csv:3: field 'gait' is 'trott'"),
    "without effect": (
        "spine,spine.phase\nnone,1\n",
        "rows.csv:2: field 'spine.phase' has no effect",
    ),
    "twice": ("frequency\n0.8\n0.6\n0.8\n", "rows.csv:4: a row is the same as that of"),
    "ragged": ("frequency,stride\n0.8\n", "rows.csv:2: has 1 values, and the first line 2 names"),
    "two columns of a name": ("frequency,frequency\n0.8,1\n", "column 'frequency' stands twice"),
    "no rows": ("frequency\n", "holds no rows"),
    "empty": ("", "an empty file"),
    "beyond the legs": (
        "stride,stance.swing_amplitude\n1.0,0.03\n",
        "values that do not go together",
    ),
}


@pytest.mark.parametrize(("text", "sentence"), WRONG.values(), ids=WRONG)
def test_a_wrong_table_is_refused_with_its_line(tmp_path, text, sentence):
    (tmp_path / "rows.csv").write_text(text)
    with pytest.raises(SpecError) as refused:
        Sweep.from_rows(tmp_path / "rows.csv")
    assert sentence in str(refused.value)


#: Fields of a sweep file, the line of the message, and what it says.
WRONG_FILES = {
    "beside vary": (
        "rows: [{frequency: 0.5}]\nvary: {stride: [0.5]}",
        2,
        "'vary' is given beside 'rows'",
    ),
    "beside sample": (
        "rows: [{frequency: 0.5}]\nsample: {sobol: 4}",
        2,
        "'sample' is given beside 'rows'",
    ),
    "no file": (
        "gait: trot\nrows: nowhere.csv",
        2,
        "'rows' is 'nowhere.csv': there is no such file",
    ),
    "no table": ("rows: design.txt", 1, "expected the path of a .csv or .parquet file"),
    "a row is a list": ("rows:\n  - {frequency: 0.5}\n  - [0.5]", 3, "is the list [0.5]: expected"),
    "a value": (
        "rows:\n  - {frequency: 0.5}\n  - {frequency: -1}",
        3,
        "'frequency' is -1: allowed is [0.001, 5] Hz",
    ),
    "a truth value": (
        "rows: [{frequency: true}]",
        1,
        "'frequency' is the truth value true: expected a number",
    ),
    "two sources": ("set: {frequency: 0.5}\nrows: [{frequency: 0.6}]", 2, "also fixed under 'set'"),
    "two sources of a structure": (
        "gait: trot\nrows:\n  - {gait: lateral_walk}",
        3,
        "varied and also given as 'gait'",
    ),
    "the pilot": (
        "rows:\n  - {pilot: {arc: {radius: 1}}}\n  - {pilot: {ark: {radius: 1}}}",
        3,
        "did you mean 'arc'?",
    ),
    "none": ("rows: []", 1, "holds no rows"),
}


@pytest.mark.parametrize(("text", "line", "sentence"), WRONG_FILES.values(), ids=WRONG_FILES)
def test_wrong_rows_of_a_file_are_refused_with_its_line(tmp_path, text, line, sentence):
    (tmp_path / "sweep.yaml").write_text(text + "\n")
    with pytest.raises(SpecError) as refused:
        Sweep.from_file(tmp_path / "sweep.yaml")
    assert sentence in str(refused.value)
    assert f"sweep.yaml:{line}: " in str(refused.value)


@pytest.mark.extra
def test_a_table_that_lost_what_its_columns_are_is_refused(tmp_path):
    """As pandas and polars write it: nobody could tell a drawn friction from a varied one."""
    duckdb = pytest.importorskip("duckdb")
    spec = {
        "vary": {"frequency": [0.5, 0.6]},
        "randomize": {"contact.friction": {"uniform": [1, 2]}},
        "plots": False,
    }
    table = run_sweep(spec, tmp_path / "out", simulator=FakeSimulator()).table
    duckdb.sql(
        f"COPY (SELECT * FROM '{tmp_path}/out/results/*.parquet') TO '{tmp_path}/lost.parquet'"
    )
    with pytest.raises(
        SpecError,
        match="a column of results, and the file does not say which columns are parameters",
    ):
        Sweep.from_rows(tmp_path / "lost.parquet")
    pq.write_table(table.slice(1), tmp_path / "known.parquet")
    assert list(Sweep.from_rows(tmp_path / "known.parquet").rows.values) == ["frequency"]
    (tmp_path / "torn.parquet").write_bytes(b"PAR1")
    with pytest.raises(SpecError, match="cannot be read as Parquet"):
        Sweep.from_rows(tmp_path / "torn.parquet")


def test_a_name_of_any_length_is_refused_at_once(tmp_path: Path) -> None:
    path = tmp_path / "rows.parquet"
    pq.write_table(pa.table({"spine.amplitude" * 20_000: [0.1]}), path)
    began = time.process_time()
    with pytest.raises(FileError, match="is not a parameter") as refused:
        read_row_table(read_mapping({}), str(path))
    assert time.process_time() - began < 5.0
    assert len(str(refused.value)) < 1000


@pytest.mark.parametrize(
    ("column", "message"),
    [
        ({"gait": [datetime.date(2020, 1, 1)]}, "row 0: field 'gait' is date .*expected a name"),
        ({"gait": [decimal.Decimal("1.0")]}, "'gait' is Decimal"),
        ({"gait": [b"trot"]}, "'gait' is bytes b'trot': expected a name"),
        ({"gait": [["trot"]]}, "'gait' is the list .*: expected a name"),
        ({"frequency": [True]}, "'frequency' is the truth value true: expected a number"),
        ({"frequency": [b"0.8"]}, "'frequency' is bytes b'0.8': expected a number"),
        (
            {"frequency": [datetime.datetime(2020, 1, 1)]},
            "'frequency' is datetime .*expected a number",
        ),
        ({"frequency": [datetime.timedelta(1)]}, "'frequency' is timedelta"),
    ],
)
def test_columns_of_other_types_are_refused(tmp_path: Path, column: Any, message: str) -> None:
    pq.write_table(pa.table(column), tmp_path / "rows.parquet")
    refused(Sweep.from_rows, message, tmp_path / "rows.parquet")


def test_decimals_are_numbers_and_a_column_twice_is_not(tmp_path: Path) -> None:
    pq.write_table(pa.table({"frequency": [decimal.Decimal("0.8"), None]}), tmp_path / "a.parquet")
    assert Sweep.from_rows(tmp_path / "a.parquet").rows.values["frequency"].tolist() == [0.8, 0.67]
    twice = pa.Table.from_arrays(
        [pa.array([1.0]), pa.array([2.0])], names=["frequency", "frequency"]
    )
    pq.write_table(twice, tmp_path / "b.parquet")
    refused(Sweep.from_rows, "column 'frequency' stands twice", tmp_path / "b.parquet")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("frequency;stride\n0,8;1,0\n", "rows.csv:1: columns are separated by ';': allowed is ','"),
        ("frequency\tstride\n0.8\t1\n", r"rows.csv:1: columns are separated by '\\t'"),
        ("frequency|stride\n", r"rows.csv:1: columns are separated by '\|'"),
        ("frequency,stride\n0,8,1,0\n", "rows.csv:2: has 4 values, .*decimal comma"),
        ('frequency\n"0,8"\n', "rows.csv:2: .* is the text '0,8': expected a number with a point"),
    ],
)
def test_semicolons_and_decimal_commas_are_named(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "rows.csv").write_text(text)
    refused(Sweep.from_rows, message, tmp_path / "rows.csv")
