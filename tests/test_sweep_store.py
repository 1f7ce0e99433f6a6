"""The result directory: chunks whole or not at all, one sweep, one writer, and clear words when something is wrong."""

import hashlib
import os
import resource
import signal
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from sweep_fake import SPEC, FakeSimulator

from nermo_mjx.runs.files import parquet_bytes
from nermo_mjx.sweep import DirectoryError, Sweep, read_table, run_sweep
from nermo_mjx.sweep.store import Store


@pytest.fixture
def done(tmp_path):
    """A finished directory of 36 rows in 9 chunks."""
    run_sweep(SPEC, tmp_path / "out", chunk=4, simulator=FakeSimulator())
    return tmp_path / "out"


@pytest.mark.draws
def test_the_directory_holds_what_other_programs_rely_on(done):
    """results/*.parquet, summary.json, sweep.yaml, run.json and plots/ are there, and nothing half-written."""
    run_sweep(SPEC | {"plots": True}, done, simulator=FakeSimulator())  # figures may be drawn later
    assert sorted(path.name for path in done.iterdir() if path.name[0] != ".") == [
        "manifest.sha256", "plots", "results", "run.json", "summary.json", "sweep.yaml",
    ]  # fmt: skip
    assert len(list(done.glob("results/*.parquet"))) == 9
    assert not [path for path in done.rglob("*") if path.suffix == ".tmp"]
    assert Sweep.from_file(done / "sweep.yaml").digest() == Sweep.from_dict(SPEC).digest()


def test_every_column_says_its_unit_meaning_and_role(done):
    """Units of parameters and metrics stand in the Parquet files themselves."""
    schema = pq.read_schema(next(done.glob("results/*.parquet")))
    about = {field.name: field.metadata for field in schema}
    assert about["frequency"][b"unit"] == b"Hz"
    assert about["spine.amplitude"][b"unit"] == b"rad"
    assert about["speed"][b"unit"] == b"m/s"
    assert about["speed"][b"role"] == b"metric"
    assert about["frequency"][b"role"] == b"varied"
    assert all(metadata[b"description"] for metadata in about.values())


def test_pandas_reads_the_results_folder(done):
    """Anyone can read the results without this package."""
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_parquet(done / "results")
    assert sorted(frame["row"]) == list(range(36))
    assert set(frame["status"]) == {"ok"}


def test_a_finished_directory_is_not_run_again(done):
    """A second run simulates nothing and gives the same table."""
    before, times = read_table(done), {path: path.stat().st_mtime_ns for path in done.glob("results/*")}
    simulator = FakeSimulator()
    result = run_sweep(SPEC, done, simulator=simulator)
    assert simulator.batches == []
    assert result.complete
    assert result.table.equals(before)
    assert times == {path: path.stat().st_mtime_ns for path in done.glob("results/*")}


def cut(path):
    path.write_bytes(path.read_bytes()[:-200])


def flip_a_bit(path):
    content = bytearray(path.read_bytes())
    content[60] ^= 4  # in the first column's page, far from the footer
    path.write_bytes(content)


def other_rows(path):
    path.write_bytes((path.parent / "chunk-00005.parquet").read_bytes())


def foreign(path):
    table = pq.read_table(path)
    table = table.replace_schema_metadata({**table.schema.metadata, b"sweep": b"another"})
    path.write_bytes(parquet_bytes(table))
    with open(path.parents[1] / "manifest.sha256", "a") as manifest:
        manifest.write(f"{hashlib.sha256(path.read_bytes()).hexdigest()}  results/{path.name}\n")


@pytest.mark.parametrize(
    "damage", [Path.unlink, cut, flip_a_bit, other_rows, foreign, lambda path: path.write_text("")]
)
def test_a_damaged_chunk_is_found_and_only_it_is_redone(done, damage):
    """Missing, cut, bit-flipped, swapped, foreign and empty chunks are run again; the other eight are not."""
    before = read_table(done)
    damage(done / "results" / "chunk-00003.parquet")
    simulator = FakeSimulator()
    result = run_sweep(SPEC, done, simulator=simulator)
    assert simulator.batches == [4]
    assert result.table.equals(before)
    assert read_table(done).equals(before)


def test_a_directory_of_another_sweep_is_refused_untouched(done):
    """One sentence names the directory; nothing in it changes."""
    before = {path: path.read_bytes() for path in done.rglob("*") if path.is_file()}
    with pytest.raises(
        DirectoryError, match=r"out holds the results of another sweep: seed is 0 there and 5 here; cho"
    ):
        run_sweep(SPEC | {"seed": 5}, done, simulator=FakeSimulator())
    assert before == {path: path.read_bytes() for path in done.rglob("*") if path.is_file()}


def test_results_without_their_sweep_are_refused(done):
    """Chunks whose sweep.yaml is gone are not taken for this sweep's."""
    (done / "sweep.yaml").unlink()
    with pytest.raises(DirectoryError, match="unknown sweep"):
        run_sweep(SPEC, done, simulator=FakeSimulator())


def test_a_broken_sweep_yaml_is_named(done):
    """A sweep.yaml that no longer reads is said to be so."""
    (done / "sweep.yaml").write_text("vary: [")
    with pytest.raises(DirectoryError, match="cannot be read"):
        run_sweep(SPEC, done, simulator=FakeSimulator())


def test_two_processes_do_not_write_one_directory(tmp_path):
    """While one holds the directory, a second is refused; afterwards it may."""
    sweep = Sweep.from_dict(SPEC)
    with Store(tmp_path, sweep), pytest.raises(DirectoryError, match="another process works in"):
        run_sweep(sweep, tmp_path, simulator=FakeSimulator())
    assert run_sweep(sweep, tmp_path, simulator=FakeSimulator()).complete


def test_shards_share_a_directory_but_not_a_shard(tmp_path):
    """Different shards work side by side; the same shard twice, or a whole run beside a shard, is refused."""
    sweep = Sweep.from_dict(SPEC)
    with Store(tmp_path, sweep, (0, 2)):
        with Store(tmp_path, sweep, (1, 2)):
            pass
        for shard in ((0, 2), None):
            with pytest.raises(DirectoryError, match="another process"), Store(tmp_path, sweep, shard):
                pass


def test_a_full_disk_is_one_sentence_and_leaves_no_half_file(tmp_path):
    """If the system rejects more bytes, finished chunks are kept, and the run can be resumed later."""
    handler, limits = signal.signal(signal.SIGXFSZ, signal.SIG_IGN), resource.getrlimit(resource.RLIMIT_FSIZE)
    simulator = FakeSimulator()
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (3000, limits[1]))  # room for the texts, not for a chunk
        with pytest.raises(DirectoryError, match=r"cannot write in .*: File too large\. What is finished is kept"):
            run_sweep(SPEC, tmp_path, chunk=36, simulator=simulator)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)
    assert simulator.batches == [36]
    assert list((tmp_path / "results").iterdir()) == []
    assert run_sweep(SPEC, tmp_path, simulator=FakeSimulator()).complete


@pytest.mark.skipif(not os.path.isdir("/sys/kernel"), reason="needs a folder that nobody may write")
def test_a_directory_that_cannot_be_written_is_one_sentence():
    """No traceback for a read-only place: the directory and the reason."""
    with pytest.raises(DirectoryError, match="cannot write in /sys/kernel/nermo: "):
        run_sweep(SPEC, "/sys/kernel/nermo", simulator=FakeSimulator())


def test_a_file_in_the_place_of_the_directory_is_one_sentence(tmp_path):
    """`--out` that names a file is refused in words."""
    (tmp_path / "out").write_text("")
    with pytest.raises(DirectoryError, match="out is a file: a directory is needed"):
        run_sweep(SPEC, tmp_path / "out", simulator=FakeSimulator())


def test_leftovers_of_a_killed_process_are_cleared(done):
    """A half-written temporary file is neither read nor kept."""
    leftover = done / "results" / ".chunk-00003.parquet.7.nermo-tmp"
    leftover.write_text("half")
    run_sweep(SPEC, done, simulator=FakeSimulator())
    assert not leftover.exists()


def test_reading_a_directory_without_results_is_one_sentence(tmp_path):
    """`read_table` names the directory."""
    with pytest.raises(DirectoryError, match="holds no results"):
        read_table(tmp_path)


def test_numbers_pass_through_the_store_unchanged(done):
    """What the simulator gave stands in the table, bit by bit."""
    frame = {name: read_table(done).column(name).to_numpy() for name in ("frequency", "spine.amplitude", "spine.phase")}
    expected = FakeSimulator().run(frame, None).metrics["speed"]
    np.testing.assert_array_equal(read_table(done).column("speed").to_numpy(), expected.astype(np.float64))
