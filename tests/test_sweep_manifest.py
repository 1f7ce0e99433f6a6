"""The manifest of a sweep's chunks: a digest of each, by which any damage is seen."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from sweep_fake import SPEC, FakeSimulator

from nermo_mjx.runs import files
from nermo_mjx.sweep import DirectoryError, Results, Sweep, read_table, run_sweep
from nermo_mjx.sweep.results import digests_of
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.store import Store, layout_of, simulated_seconds


@pytest.fixture(scope="module")
def done(tmp_path_factory):
    """A finished directory of 36 rows in 9 chunks."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("done"), chunk=4, simulator=FakeSimulator()).out


@pytest.fixture
def copy(done, tmp_path):
    """The same, to be damaged."""
    return Path(shutil.copytree(done, tmp_path / "copy"))


def layout(out):
    sweep = Sweep.from_file(out / "sweep.yaml")
    return layout_of(simulated_seconds(sweep, Sample(sweep)), sweep.chunk)


def flaw(out, chunk=3):
    """What is wrong with a chunk of a directory; empty if nothing is."""
    states = dict(Store(out, Sweep.from_file(out / "sweep.yaml")).states(layout(out)))
    return states[chunk].flaw


def lines(out):
    return [line.split("  ") for path in out.glob("manifest*") for line in path.read_text().splitlines()]


def test_each_chunk_has_its_digest_in_the_form_that_sha256sum_reads(done):
    """By its path in the directory, so that a directory can be moved and checked anywhere."""
    noted = {name: digest for digest, name in lines(done)}
    assert noted == {
        path.relative_to(done).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in done.glob("results/*.parquet")
    }
    assert len(noted) == 9
    if shutil.which("sha256sum"):
        checked = subprocess.run(["sha256sum", "--check", "--strict", "--quiet", "manifest.sha256"], cwd=done)
        assert checked.returncode == 0


def test_any_flipped_byte_is_seen(copy):
    """Pages, footer, its length, the letters at both ends: each byte of the file counts."""
    path = copy / "results" / "chunk-00003.parquet"
    content = path.read_bytes()
    store, cut = Store(copy, Sweep.from_file(copy / "sweep.yaml")), layout(copy)
    assert store.inspect(3, cut[3], digests_of(store.out)).note is not None
    digests = digests_of(store.out)
    for at in range(0, len(content), 7):
        damaged = bytearray(content)
        damaged[at] ^= 1 << (at % 8)
        path.write_bytes(damaged)
        assert store.inspect(3, cut[3], digests).flaw == "is damaged", at


@pytest.mark.parametrize("cut", [0, 1, 7, 8, 100, -1, -200])
def test_a_cut_file_is_seen(copy, cut):
    """However much of it is left."""
    path = copy / "results" / "chunk-00003.parquet"
    path.write_bytes(path.read_bytes()[:cut])
    assert flaw(copy) == "is damaged"


def test_a_damaged_chunk_is_kept_beside_what_replaces_it(copy):
    """It has a new name, outside of the folder that readers take whole; both digests stay noted."""
    path, before = copy / "results" / "chunk-00003.parquet", read_table(copy)
    damaged = path.read_bytes()[:-20]
    path.write_bytes(damaged)
    said = []
    result = run_sweep(SPEC, copy, simulator=FakeSimulator(), warn=said.append)
    assert said == [f"chunk 3 of {copy} is damaged; it is kept in results.aside, and run again."]
    assert result.table.equals(before)
    assert [kept.read_bytes() for kept in copy.glob("results.aside/*")] == [damaged]
    assert flaw(copy) == ""


def test_a_chunk_that_cannot_be_read_is_named(copy):
    """Whether it is the footer that is damaged or a page of a column that is asked for later."""
    path = copy / "results" / "chunk-00003.parquet"
    content, chunks = path.read_bytes(), sorted(copy.glob("results/*"))
    speed = pq.read_metadata(path).row_group(0).column(pq.read_schema(path).get_field_index("speed"))
    damaged = bytearray(content)
    damaged[(speed.dictionary_page_offset or speed.data_page_offset) + speed.total_compressed_size - 1] ^= 1
    path.write_bytes(damaged)
    results = Results(chunks)
    assert results.column("frequency").shape == (36,)
    with pytest.raises(DirectoryError, match=r"chunk-00003\.parquet cannot be read \(.*\): run the same command again"):
        results.column("speed")
    path.write_bytes(content[:-20])
    with pytest.raises(DirectoryError, match=r"chunk-00003\.parquet cannot be read"):
        Results(chunks)


def test_a_digest_that_was_cut_off_costs_no_other_one(copy):
    """A process that is killed in the middle of a line leaves its chunk unwritten; the next line stands alone."""
    manifest, path = copy / "manifest.sha256", copy / "results" / "chunk-00003.parquet"
    manifest.write_bytes(manifest.read_bytes() + b"0123456789abcdef")
    path.unlink()
    assert run_sweep(SPEC, copy, simulator=FakeSimulator()).chunks_run == 1
    simulator = FakeSimulator()
    assert run_sweep(SPEC, copy, simulator=simulator).complete
    assert simulator.batches == []


def test_a_chunk_is_noted_before_it_is_there(tmp_path, monkeypatch):
    """A process killed between the two leaves nothing that would pass for a chunk."""
    replace = files.replace_file

    def killed(path, content):
        if path.suffix == ".parquet":
            raise KeyboardInterrupt
        replace(path, content)

    monkeypatch.setattr("nermo_mjx.runs.directory.replace_file", killed)
    with pytest.raises(KeyboardInterrupt):
        run_sweep(SPEC, tmp_path, chunk=36, simulator=FakeSimulator())
    assert [name for _, name in lines(tmp_path)] == ["results/chunk-00000.parquet"]
    assert not list(tmp_path.glob("results/*"))


def test_shards_note_their_chunks_in_files_of_their_own(tmp_path):
    """None waits for another one, and each sees what the others wrote."""
    for part in (0, 1):
        result = run_sweep(SPEC, tmp_path, chunk=4, shard=(part, 2), simulator=FakeSimulator())
    assert result.complete
    assert sorted(path.name for path in tmp_path.glob("manifest*")) == [
        "manifest-0-of-2.sha256", "manifest-1-of-2.sha256",
    ]  # fmt: skip
    path = tmp_path / "results" / "chunk-00003.parquet"
    path.write_bytes(path.read_bytes()[:-9] + b"?" + path.read_bytes()[-8:])
    assert flaw(tmp_path) == "is damaged"
