# Tests of sweep/run.py, runs/code.py
"""The code that made a sweep's rows: recorded for each row, and rows of two codes are mixed only on request."""

from __future__ import annotations

import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import SPEC, FakeSimulator, contents

from nermo_mjx.physics import resolve_engine
from nermo_mjx.rollout import Setup
from nermo_mjx.runs import Interrupted, OtherCode, Watch, code, codes_of, stamp
from nermo_mjx.sweep import Sweep, run_sweep
from nermo_mjx.sweep.table import columns_of


@pytest.fixture
def newer(monkeypatch):
    """The package once more, as version 9.9.9."""
    return lambda: monkeypatch.setattr(code, "__version__", "9.9.9")


@pytest.fixture
def begun(tmp_path):
    """A directory with two of four chunks."""
    with pytest.raises(Interrupted):
        run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(stop_at=2))
    return tmp_path


def test_each_row_and_each_chunk_name_the_code_that_made_them(tmp_path):
    """The column `code` has the stamp's short name, and run.json what it stands for."""
    table = run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(engine="c")).table
    expected = stamp(Sweep.from_dict(SPEC).setup.load().fingerprint, "c")
    assert codes_of(tmp_path) == {expected.id: expected}
    assert columns_of(table, "code") == ["code"]
    assert set(table.column("code").to_pylist()) == {expected.id}
    for path in tmp_path.glob("results/*.parquet"):
        assert pq.read_schema(path).metadata[b"code"].decode() == expected.id


def test_accepted_code_keeps_what_is_there_and_tells_the_rows_apart(begun, newer):
    """Two chunks of each; later the same code resumes without being accepted again."""
    newer()
    with pytest.raises(Interrupted):
        run_sweep(SPEC, begun, simulator=FakeSimulator(stop_at=1), accept_new_code=True)
    simulator = FakeSimulator()
    result = run_sweep(SPEC, begun, simulator=simulator)
    assert simulator.batches == [9]
    codes = result.table.column("code").to_pylist()
    assert {name: codes.count(name) for name in codes_of(begun)} == dict.fromkeys(
        codes_of(begun), 18
    )
    assert [code.package for code in codes_of(begun).values()][1:] == ["9.9.9"]


def test_a_directory_keeps_its_engine_unless_another_one_is_accepted(begun):
    """A refusal says what differs, and nothing is written; once it is accepted, the summary names both."""
    before = contents(begun)
    with pytest.raises(
        OtherCode, match=r"made by other code: engine fake, not other;.*--accept-new-code"
    ):
        run_sweep(SPEC, begun, simulator=FakeSimulator(engine="other"))
    assert contents(begun) == before
    result = run_sweep(SPEC, begun, simulator=FakeSimulator(engine="other"), accept_new_code=True)
    assert result.summary["engine"] == "fake, other"


def test_auto_is_the_engine_that_a_directory_was_begun_with(tmp_path, monkeypatch):
    """And elsewhere what this machine would choose."""
    engines = []

    class Noted(FakeSimulator):
        def __init__(self, setup, engine):
            super().__init__(engine=engine, stop_at=1)
            engines.append(engine)

    monkeypatch.setattr("nermo_mjx.sweep.simulating.Simulator", Noted)
    for engine in ("mjx", "auto"):
        with pytest.raises(Interrupted):
            run_sweep(SPEC, tmp_path / "begun", chunk=9, engine=engine)
    with pytest.raises(Interrupted):
        run_sweep(SPEC, tmp_path / "new", chunk=9)
    assert engines == ["mjx", "mjx", resolve_engine("auto")]


def test_a_complete_directory_is_read_by_other_code(begun, newer):
    """Nothing is simulated, so nothing is refused."""
    table = run_sweep(SPEC, begun, simulator=FakeSimulator()).table
    newer()
    result = run_sweep(SPEC, begun, simulator=FakeSimulator(engine="other"))
    assert (result.complete, result.chunks_run) == (True, 0)
    assert result.table.equals(table)


def test_an_engine_that_cannot_run_here_does_not_claim_a_directory(tmp_path):
    """A shard that fails before its first chunk leaves no code behind that would refuse the others."""
    with pytest.raises(ValueError, match="engine is 'steam'"):
        run_sweep(SPEC, tmp_path, engine="steam", chunk=9, shard=(0, 2))
    assert codes_of(tmp_path) == {}


def test_rows_made_with_other_defaults_are_kept_and_not_used(begun, monkeypatch):
    """They are told, run again, and out of the table; with the former defaults they are back."""
    contents = {path.name: path.read_bytes() for path in begun.glob("results/*.parquet")}
    with monkeypatch.context() as patch:
        defaults = Setup.defaults
        patch.setattr(Setup, "defaults", lambda self: defaults(self) | {"stride": 0.123})
        patch.setattr(Sweep, "digest", lambda self: "beef")
        messages = []
        result = run_sweep(
            SPEC, begun, simulator=FakeSimulator(), watch=Watch(warn=messages.append)
        )
        assert messages == [
            f"{begun} has parts of another job, or made with other defaults: now in former."
        ]
        assert {path.name: path.read_bytes() for path in begun.glob("former/results/*")} == contents
        assert result.chunks_run == result.table.num_rows / 9 == 4
        assert len(list(begun.glob("results/*"))) == 4
    assert run_sweep(SPEC, begun, simulator=FakeSimulator()).chunks_run == 2
    assert contents.keys() < {path.name for path in begun.glob("results/*")}


def test_a_stamp_reads_every_room_that_decides_the_numbers():
    """Whatever room the simulator's own rooms import, its sources are in the stamp, too."""
    package = Path(code.__file__).parents[1]
    rooms = {path.name for path in package.iterdir() if (path / "__init__.py").exists()}
    imported = {
        name
        for room in code.ROOMS
        for path in (package / room).rglob("*.py")
        for name in re.findall(
            r"^\s*(?:from|import) nermo_mjx\.(\w+)", path.read_text(), re.MULTILINE
        )
    }
    assert {"dynamics", "physics"} <= imported
    # Directories say how a run is kept, not what it is; a policy is a controller, read from a file that is stamped.
    assert imported & rooms - {"runs", "learn"} <= set(code.ROOMS)
