# Tests of sweep/run.py, sweep/table.py
"""A sweep's directory end to end: what is in it, what goes wrong, shards; the store alone is in `test_rows.py`."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import threading
import time
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import SPEC, FakeSimulator, contents, part_of
from test_rows import FullDisk

from nermo_mjx import files
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import Interrupted, JobFailed, OtherCode, Watch
from nermo_mjx.runs.rows import Runs
from nermo_mjx.sweep import (
    DirectoryError,
    Results,
    SpecError,
    Sweep,
    read_table,
    run_sweep,
)
from nermo_mjx.sweep.table import SWEEP_RECORD_FILE, SweepRecord


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The table of a sweep that nothing disturbs."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("sweep"), simulator=FakeSimulator()).table


@pytest.fixture
def done(tmp_path):
    """A finished directory of 36 rows in 9 parts."""
    run_sweep(SPEC, tmp_path / "out", chunk=4, simulator=FakeSimulator())
    return tmp_path / "out"


def goes_on(out, reference, at_most):
    """The directory is whole: the same sweep completes it with so many batches, and the table is as if undisturbed."""
    simulator = FakeSimulator()
    result = run_sweep(SPEC, out, simulator=simulator)
    assert result.complete
    assert result.table.equals(reference)
    assert len(simulator.batches) <= at_most
    assert not list(out.rglob("*.nermo-tmp"))


# --- what other programs rely on


@pytest.mark.release
def test_the_directory_holds_what_other_programs_rely_on(done):
    """Files, and in each column its unit, its meaning and its role; readers of Parquet need no other program."""
    pandas = pytest.importorskip("pandas")
    run_sweep(SPEC | {"plots": True}, done, simulator=FakeSimulator())  # figures may be drawn later
    names = {path.name for path in done.iterdir() if path.name[0] != "."}
    assert names == {"plots", "results", "run.json", "summary.json", "sweep.json", "sweep.yaml"}
    assert Sweep.from_file(done / "sweep.yaml").digest() == Sweep.from_dict(SPEC).digest()
    metadata_by_name = {field.name: field.metadata for field in pq.read_schema(part_of(done, 0))}
    assert (metadata_by_name["frequency"][b"unit"], metadata_by_name["speed"][b"unit"]) == (
        b"Hz",
        b"m/s",
    )
    assert (
        metadata_by_name["frequency"][b"role"],
        metadata_by_name["speed"][b"role"],
        metadata_by_name["key"][b"role"],
    ) == (
        b"varied",
        b"metric",
        b"key",
    )
    assert all(metadata[b"description"] for metadata in metadata_by_name.values())
    assert sorted(pandas.read_parquet(done / "results")["row"]) == list(range(36))
    assert (
        "key"
        not in read_table(done).column_names + Results(sorted(done.glob("results/*"))).schema.names
    )


# --- damage


@pytest.mark.parametrize(
    "damage",
    [
        lambda path, second_path: path.unlink(),
        lambda path, second_path: path.write_bytes(
            path.read_bytes()[:-300] + b"?" + path.read_bytes()[-299:]
        ),
    ],
)
def test_damaged_rows_are_told_kept_and_run_again(done, reference, damage):
    """One sentence names the file; all others stay as they are."""
    path, messages = part_of(done, 3), []
    damage(path, part_of(done, 35))
    damaged = [path.read_bytes()] if path.exists() else []
    result = run_sweep(SPEC, done, simulator=FakeSimulator(), watch=Watch(warn=messages.append))
    assert messages == [
        f"{path} is damaged; it is kept in results.aside, and its runs are made again."
    ] * len(damaged)
    assert [backup.read_bytes() for backup in done.glob("results.aside/*")] == damaged
    assert result.chunks_run == 1
    assert result.table.equals(reference)


def test_a_part_that_cannot_be_read_is_named(done):
    """Whether it is the footer that is damaged or a page of a column that is asked for later."""
    path, parts = part_of(done, 3), sorted(done.glob("results/*"))
    content, speed = (
        path.read_bytes(),
        pq.read_metadata(path).row_group(0).column(pq.read_schema(path).names.index("speed")),
    )
    damaged = bytearray(content)
    damaged[
        (speed.dictionary_page_offset or speed.data_page_offset) + speed.total_compressed_size - 1
    ] ^= 1
    path.write_bytes(damaged)
    results = Results(parts)
    assert results.column("frequency").shape == (36,)
    with pytest.raises(
        DirectoryError, match=rf"{path.name} cannot be read \(.*\): run the same command again"
    ):
        results.column("speed")
    path.write_bytes(content[:-20])
    with pytest.raises(DirectoryError, match=rf"{path.name} cannot be read"):
        Results(parts)


def test_rows_that_two_processes_made_count_once(done, tmp_path, reference):
    """As of a part that was moved aside and put back after its rows were made again, in other company."""
    part_path = part_of(done, 3)
    part_path.rename(tmp_path / part_path.name)
    run_sweep(SPEC, done, simulator=FakeSimulator())
    run_sweep(SPEC, tmp_path / "other", chunk=7, simulator=FakeSimulator())
    for path in [tmp_path / part_path.name, *(tmp_path / "other/results").glob("*")]:
        path.rename(done / "results" / path.name)
    assert read_table(done).equals(reference)
    assert Results(sorted(done.glob("results/*"))).statuses == {"ok": 36}
    assert run_sweep(SPEC, done, simulator=FakeSimulator()).chunks_run == 0


def test_a_disk_that_loses_everything_is_not_tried_for_ever(tmp_path, monkeypatch, reference):
    def loses(path, content, replace=files.replace_file):
        replace(path, content[:-1] if path.suffix == ".parquet" else content)

    with monkeypatch.context() as patch:
        patch.setattr("nermo_mjx.runs.directory.replace_file", loses)
        with pytest.raises(DirectoryError, match="loses what is written to it"):
            run_sweep(SPEC, tmp_path, chunk=12, simulator=FakeSimulator())
    goes_on(tmp_path, reference, 3)


# --- no room, no permission, another sweep


@pytest.mark.parametrize("file", range(9))
def test_a_full_disk_is_one_sentence_wherever_it_strikes(tmp_path, monkeypatch, reference, file):
    """In the sweep's two files, in run.json twice, in the parts, in summary and figures; then it goes on."""
    opened = []
    with monkeypatch.context() as patch:
        # In the one function that all others write by, so that it strikes whoever imported which before.
        def opens(path, mode, **how):
            if "w" not in mode:
                return open(path, mode, **how)
            opened.append(path)
            return FullDisk(path, mode) if len(opened) > file else open(path, mode)

        patch.setattr(files, "open", opens, raising=False)
        with pytest.raises(DirectoryError) as caught:
            run_sweep(SPEC | {"plots": True}, tmp_path, chunk=12, simulator=FakeSimulator())
    folder = opened[file].parent if opened[file].parent.name == "plots" else tmp_path
    assert str(caught.value) == (
        f"cannot write in {folder}: No space left on device. What is finished is kept: run the same command again when "
        "there is room."
    )
    goes_on(tmp_path, reference, max(min(3, 7 - file), 0))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda out: (out / "sweep.yaml").write_text("vary: ["), "a sweep that cannot be read"),
        (lambda out: (out / "sweep.yaml").unlink(), "results of an unknown sweep"),
        (
            lambda out: SPEC | {"seed": 5},
            "the results of another sweep: seed is 0 there and 5 here; choose",
        ),
        (
            lambda out: SPEC | {"run": {"cycles": 5, "warmup_cycles": 1}, "gait": "lateral_walk"},
            "the results of another sweep: gait is trot there and lateral_walk here; run.cycles is 4",
        ),
        (
            lambda out: SPEC | {"vary": SPEC["vary"] | {"duty": [0.5]}},
            r"the results of another sweep: vary.duty.values is absent there and \[0.5\] here; choose",
        ),
        (
            lambda out: SPEC | {"vary": dict(reversed(SPEC["vary"].items()))},
            "the results of another sweep: the parameters under vary or randomize stand in another order",
        ),
    ],
)
def test_a_directory_of_something_else_is_refused_untouched(done, change, sentence):
    """The first fields that differ, with both values."""
    spec = change(done)
    before = contents(done)
    with pytest.raises(DirectoryError, match=f"out holds {sentence}"):
        run_sweep(spec if isinstance(spec, dict) else SPEC, done, simulator=FakeSimulator())
    assert contents(done) == before


def test_places_that_are_no_directories_are_one_sentence(tmp_path):
    (tmp_path / "out").write_text("")
    with pytest.raises(DirectoryError, match="out is a file: a directory is needed"):
        run_sweep(SPEC, tmp_path / "out", simulator=FakeSimulator())
    with pytest.raises(DirectoryError, match="holds no results"):
        read_table(tmp_path)
    if os.path.isdir("/sys/kernel"):
        with pytest.raises(DirectoryError, match="cannot write in /sys/kernel/nermo: "):
            run_sweep(SPEC, "/sys/kernel/nermo", simulator=FakeSimulator())


# --- a simulation that fails, interruptions


@pytest.mark.parametrize(
    ("error", "expected", "sentence"),
    [
        (
            ValueError("no\nsuch luck"),
            JobFailed,
            r"failed: ValueError: no\. What is finished is kept in .+: run the",
        ),
        (
            MemoryError(),
            JobFailed,
            r"failed: MemoryError\. .+: take a smaller --chunk in another directory\.$",
        ),
        (ParameterError("stride is 9."), SpecError, r"are refused: stride is 9\.$"),
    ],
)
def test_a_failed_simulation_names_its_rows(tmp_path, reference, error, expected, sentence):
    with pytest.raises(expected, match=r"^rows 9, 10, 11, 12 and 5 more " + sentence) as caught:
        run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(fail_at=2, error=error))
    assert caught.value.__cause__ is error
    goes_on(tmp_path, reference, 2)


class Deaf(FakeSimulator):
    """Is interrupted in its third batch, and swallows it, as a destructor or a callback of JAX would."""

    def run(self, *args, **kwargs):
        if len(self.batches) == 2:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
        return super().run(*args, **kwargs)


def test_an_interruption_that_something_swallows_still_counts(tmp_path):
    """The batch reports its progress, and that is the end."""
    with pytest.raises(Interrupted):
        run_sweep(SPEC, tmp_path, chunk=4, simulator=Deaf())
    assert len(list(tmp_path.glob("results/*.parquet"))) == 2


def test_batches_are_written_while_the_next_one_is_simulated(tmp_path, monkeypatch):
    """In another thread, one at a time, and never more than one behind."""
    add, threads, behind = Runs.add, set(), []
    simulator = FakeSimulator()

    def slow(*args):
        """Takes until the next batch has begun, and some time in which the one after that must not."""
        threads.add(threading.current_thread())
        until = time.monotonic() + 10.0
        while len(simulator.batches) < min(len(behind) + 2, 9) and time.monotonic() < until:
            time.sleep(0.001)
        time.sleep(0.03)
        behind.append(len(simulator.batches) - len(behind))
        return add(*args)

    monkeypatch.setattr(Runs, "add", slow)
    run_sweep(SPEC, tmp_path, chunk=4, simulator=simulator)
    assert len(threads) == 1
    assert threads != {threading.main_thread()}
    assert max(behind) == 2  # the one that is written, and the next


@pytest.mark.parametrize("broken", [0, 8])
def test_an_error_of_the_writer_ends_the_sweep(tmp_path, monkeypatch, reference, broken):
    """While the next batch but one is not begun yet, or at the end; what was computed by then is kept."""
    add, simulator, written = Runs.add, FakeSimulator(), []

    def fails(*args):
        written.append(args)
        if len(written) == broken + 1:
            raise DirectoryError("no room")
        return add(*args)

    with monkeypatch.context() as patch:
        patch.setattr(Runs, "add", fails)
        with pytest.raises(DirectoryError, match="no room"):
            run_sweep(SPEC, tmp_path, chunk=4, simulator=simulator)
    assert len(simulator.batches) == min(broken + 2, 9)
    goes_on(tmp_path, reference, 9 - len(simulator.batches) + 1)


# --- shards


class Beside(FakeSimulator):
    """Does something else, once, while one of its batches is simulated."""

    def __init__(self, what, at=0, **more):
        super().__init__(**more)
        self.what, self.at = what, at

    def run(self, *args, **kwargs):
        if len(self.batches) == self.at:
            self.what()
        return super().run(*args, **kwargs)


@pytest.mark.release
def test_three_shards_make_the_table_of_one(tmp_path, simulator):
    """Real walks in MuJoCo C, by one process and by shards 0/3 to 2/3: the same numbers, to the last bit."""
    walks = {
        "vary": {"frequency": {"linspace": [0.7, 1.2, 7]}},
        "run": {"cycles": 2, "warmup_cycles": 1},
    }
    walks |= {"chunk": 2, "plots": False}
    walked = run_sweep(walks, tmp_path / "one", simulator=simulator("c")).table
    for part in range(3):
        result = run_sweep(walks, tmp_path / "three", shard=(part, 3), simulator=simulator("c"))
        assert result.complete == (part == 2)
    assert result.table.schema.equals(walked.schema, check_metadata=True)
    for name in walked.column_names:
        np.testing.assert_array_equal(
            result.table.column(name), walked.column(name), strict=True, err_msg=name
        )


def test_a_lost_shard_is_named_by_the_others(tmp_path, reference):
    """The process that runs reports how many rows are missing, and the command that runs them."""
    for shard in ((0, 3), (2, 3)):
        result = run_sweep(SPEC, tmp_path, chunk=4, shard=shard, simulator=FakeSimulator())
    assert (result.complete, result.rows_done, result.rows) == (False, 24, 36)
    assert result.missing == (
        "12 of 36 runs are missing; unless they are being run, run them with --shard 1/3."
    )
    assert run_sweep(SPEC, tmp_path, shard=(1, 3), simulator=FakeSimulator()).table.equals(
        reference
    )


def test_two_shards_begun_together_on_unlike_machines_do_not_mix_engines(tmp_path):
    """The second one begins while the first one has written nothing yet; it is refused, and adds no row."""
    refused = []

    def second():
        with pytest.raises(
            OtherCode, match=r"made by other code: engine c, not warp;.*--accept-new-code"
        ) as caught:
            run_sweep(SPEC, tmp_path, chunk=4, shard=(1, 2), simulator=FakeSimulator(engine="warp"))
        refused.append(caught.value)

    run_sweep(SPEC, tmp_path, chunk=4, shard=(0, 2), simulator=Beside(second, engine="c"))
    assert refused
    assert len(set(read_table(tmp_path).column("code").to_pylist())) == 1
    result = run_sweep(SPEC, tmp_path, shard=(1, 2), simulator=FakeSimulator(engine="c"))
    assert result.summary["engine"] == "c"


@pytest.mark.parametrize("last", [0, 1])
def test_whichever_shard_finds_the_table_complete_sums_up(tmp_path, last):
    """The one that began first, too, where the other one ends before it."""

    def other():
        assert not run_sweep(
            SPEC, tmp_path, chunk=4, shard=(1 - last, 2), simulator=FakeSimulator()
        ).summary

    result = run_sweep(SPEC, tmp_path, chunk=4, shard=(last, 2), simulator=Beside(other, at=2))
    assert result.complete
    assert (
        json.loads((tmp_path / "summary.json").read_text())["rows"] == result.summary["rows"] == 36
    )


def test_a_shard_that_died_before_it_summed_up_does_so_when_it_is_run_again(tmp_path, monkeypatch):
    """Nothing is simulated again; the summary is that of an undisturbed sweep, times apart."""
    whole = run_sweep(SPEC, tmp_path / "whole", chunk=4, simulator=FakeSimulator()).summary
    run_sweep(SPEC, tmp_path, chunk=4, shard=(0, 2), simulator=FakeSimulator())
    with monkeypatch.context() as patch:
        patch.setattr(
            "nermo_mjx.sweep.run.summarize", lambda _: (_ for _ in ()).throw(KeyboardInterrupt)
        )
        with pytest.raises(KeyboardInterrupt):
            run_sweep(SPEC, tmp_path, shard=(1, 2), simulator=FakeSimulator())
    assert not (tmp_path / "summary.json").exists()
    result = run_sweep(SPEC, tmp_path, shard=(0, 2), simulator=FakeSimulator())
    assert result.chunks_run == 0
    times = {"wall_seconds", "steps_per_second"}
    assert {k: v for k, v in result.summary.items() if k not in times} == {
        k: v for k, v in whole.items() if k not in times
    }


RECORD_OF_THREE = {
    "rows": 3,
    "fields": {"set": {}},
    "labelled": [],
    "parameters": {},
    "comparison": None,
}


WRONG = ({"rows": "3"}, {"fields": {}}, {"parameters": 1})


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{",
        "null",
        '{"rows": 3}',
        "[" * 5000,
        *(json.dumps(RECORD_OF_THREE | wrong_entry) for wrong_entry in WRONG),
    ],
)
def test_a_damaged_record_is_one_sentence(tmp_path: Path, text: str) -> None:
    (tmp_path / SWEEP_RECORD_FILE).write_text(text)
    with pytest.raises(
        DirectoryError, match=r"sweep.json is damaged: run nermo-mjx sweep .* again"
    ):
        SweepRecord.of_directory(tmp_path)
