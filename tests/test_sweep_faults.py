"""Failures while a sweep runs: one sentence each, and a directory that can be resumed."""

import contextlib
import errno
import io
import json
import multiprocessing
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import sweep_fake
from click.testing import CliRunner
from sweep_fake import SPEC, FakeSimulator

from nermo_mjx.cli import main
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs import files
from nermo_mjx.sweep import DirectoryError, SpecError, SweepError, SweepInterrupted, read_table, run_sweep
from nermo_mjx.sweep.store import Store

pytestmark = pytest.mark.process


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The table of a sweep that nothing disturbs."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("sweep"), simulator=FakeSimulator()).table


@pytest.fixture(autouse=True, scope="module")
def warm():
    """Modules that killed processes need are imported once."""
    multiprocessing.get_context("forkserver").set_forkserver_preload(["sweep_fake", "nermo_mjx.sweep"])


def goes_on(out, reference, at_most):
    """The directory is whole: the same sweep completes it with so many chunks, and the table is as if undisturbed."""
    simulator = FakeSimulator()
    result = run_sweep(SPEC, out, simulator=simulator)
    assert result.complete
    assert result.table.equals(reference)
    assert len(simulator.batches) <= at_most
    assert not list(out.rglob("*.nermo-tmp"))


# --- damage


@pytest.mark.parametrize(
    ("damage", "flaw"),
    [
        (lambda path: path.write_bytes(b""), "is damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-1]), "is damaged"),
        (lambda path: path.write_bytes(path.read_bytes()[:-300] + b"?" + path.read_bytes()[-299:]), "is damaged"),
        (lambda path: path.write_bytes(path.with_name("chunk-00005.parquet").read_bytes()), "holds other rows"),
    ],
)
def test_a_damaged_chunk_is_told_and_run_again(tmp_path, reference, damage, flaw):
    """One sentence names the chunk and what is wrong with it; also in the footer, which no page covers."""
    run_sweep(SPEC, tmp_path, chunk=4, simulator=FakeSimulator())
    damage(tmp_path / "results" / "chunk-00003.parquet")
    said = []
    result = run_sweep(SPEC, tmp_path, simulator=FakeSimulator(), warn=said.append)
    assert said == [f"chunk 3 of {tmp_path} {flaw}; it is kept in results.aside, and run again."]
    assert result.chunks_run == 1
    assert result.table.equals(reference)


class Vandal(FakeSimulator):
    """Damages the first chunk while the last one is simulated."""

    def __init__(self, out):
        super().__init__()
        self.out = out

    def run(self, *args, **kwargs):
        if len(self.batches) == 8:
            path = self.out / "results" / "chunk-00000.parquet"
            path.write_bytes(path.read_bytes()[:-20])
        return super().run(*args, **kwargs)


def test_a_chunk_that_is_damaged_meanwhile_is_found_in_the_end(tmp_path, reference):
    """What was written is read again before it is summed up."""
    simulator, said = Vandal(tmp_path), []
    result = run_sweep(SPEC, tmp_path, chunk=4, simulator=simulator, warn=said.append)
    assert len(simulator.batches) == 10
    assert said == [f"chunk 0 of {tmp_path} is damaged; it is kept in results.aside, and run again."]
    assert result.table.equals(reference)


def test_a_disk_that_loses_everything_is_not_tried_for_ever(tmp_path, monkeypatch, reference):
    """Chunks that are never as they were written end in a sentence."""

    def loses(path, content, replace=files.replace_file):
        replace(path, content[:-1] if path.suffix == ".parquet" else content)

    with monkeypatch.context() as patch:
        patch.setattr("nermo_mjx.runs.directory.replace_file", loses)
        with pytest.raises(DirectoryError, match="loses what is written to it"):
            run_sweep(SPEC, tmp_path, chunk=12, simulator=FakeSimulator())
    goes_on(tmp_path, reference, 3)


# --- no room, no permission


class FullDisk(io.FileIO):
    """A file on a disk with room for half of what is written to it."""

    def write(self, content):
        super().write(content[: len(content) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize(
    ("kept", "left", "folder"),
    [
        ((), 9, ""),
        (("sweep.yaml", "run.json"), 9, ""),
        (("sweep.yaml", "run.json", "results"), 9, ""),
        (("sweep.yaml", "run.json", "manifest", "00000", "00001", "00002"), 6, ""),
        (("sweep.yaml", "run.json", "manifest", "results"), 0, ""),
        (("sweep.yaml", "run.json", "manifest", "results", "summary"), 0, "plots"),
    ],
)
def test_a_full_disk_is_one_sentence_wherever_it_strikes(tmp_path, monkeypatch, reference, kept, left, folder):
    """At the beginning, in the list of the chunks, in the middle of a chunk, in the summary, and in the figures."""
    with monkeypatch.context() as patch:
        # In the one function that all others write by, so that it strikes whoever imported which before.
        def opened(path, mode):
            return open(path, mode) if any(name in str(path) for name in kept) else FullDisk(path, mode)

        patch.setattr(files, "open", opened, raising=False)
        with pytest.raises(DirectoryError) as caught:
            run_sweep(SPEC | {"plots": True}, tmp_path, chunk=4, simulator=FakeSimulator())
    assert str(caught.value) == (
        f"cannot write in {tmp_path / folder}: No space left on device. What is finished is kept: run the same command "
        "again when there is room."
    )
    goes_on(tmp_path, reference, left)


def mounted(folder, *options):
    """Mount a small file system, or skip where that is not permitted."""
    folder.mkdir(exist_ok=True)
    done = subprocess.run(["mount", "-t", "tmpfs", *options, "tmpfs", str(folder)], capture_output=True)
    if done.returncode:
        pytest.skip("mounting is not permitted")


@pytest.mark.skipif(sys.platform != "linux" or os.geteuid() != 0, reason="only root may mount")
def test_a_really_full_disk_keeps_what_is_finished(tmp_path, reference):
    """A file system of a few pages fills up with chunks; with space again, the sweep resumes. Read-only is reported,
    too."""
    disk = tmp_path / "disk"
    mounted(disk, "-o", "size=128k")
    try:
        with pytest.raises(DirectoryError, match=r"No space left on device\. What is finished is kept"):
            run_sweep(SPEC, disk / "out", chunk=1, simulator=FakeSimulator())
        kept = len(list((disk / "out" / "results").glob("*.parquet")))
        assert 1 <= kept < 36
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        with pytest.raises(DirectoryError, match=r"cannot write in .*: Read-only file system\.$"):
            run_sweep(SPEC, disk / "out", simulator=FakeSimulator())
        subprocess.run(["mount", "-o", "remount,rw,size=8m", str(disk)], check=True)
        goes_on(disk / "out", reference, 36 - kept)
    finally:
        subprocess.run(["umount", "-l", str(disk)], check=True)


# --- a simulation that fails, a spec that changed, a second process


@pytest.mark.parametrize(
    ("error", "expected", "sentence"),
    [
        (ValueError("no\nsuch luck"), SweepError, r"failed: ValueError: no\. What is finished is kept in .+: run the"),
        (MemoryError(), SweepError, r"failed: MemoryError\. .+: take a smaller --chunk in another directory\.$"),
        (ParameterError("stride is 9."), SpecError, r"is refused: stride is 9\.$"),
    ],
)
def test_a_failed_simulation_names_its_chunk_and_rows(tmp_path, reference, error, expected, sentence):
    """Finished chunks are kept, and the sweep resumes from there."""
    with pytest.raises(expected, match=r"^chunk 2 \(rows 9, 10, 11, 12 and 5 more\) " + sentence) as caught:
        run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(fail_at=2, error=error))
    assert caught.value.__cause__ is error
    assert len(list(tmp_path.glob("results/*.parquet"))) == 2
    goes_on(tmp_path, reference, 2)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"seed": 5}, "seed is 0 there and 5 here; choose"),
        (
            {"run": {"cycles": 5, "warmup_cycles": 1}, "gait": "lat"},
            "gait is trt there and lat here; run.cycles is 4",
        ),
        (
            {"vary": SPEC["vary"] | {"frequency": [0.5]}},
            r"vary.frequency.values is \[0.5, 0.7, 0.9, 1.1\] there",
        ),
        ({"vary": SPEC["vary"] | {"duty": [0.5]}}, r"vary.duty.values is absent there and \[0.5\] here; choose"),
        ({"vary": dict(reversed(SPEC["vary"].items()))}, "the parameters under vary or randomize stand in another ord"),
    ],
)
def test_a_changed_sweep_says_what_changed(tmp_path, change, sentence):
    """The first fields that differ, with both values, and nothing is touched."""
    run_sweep(SPEC, tmp_path, simulator=FakeSimulator())
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(DirectoryError, match=f"holds the results of another sweep: {sentence}"):
        run_sweep(SPEC | change, tmp_path, simulator=FakeSimulator())
    assert before == {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


def test_the_command_ends_with_one_sentence_and_1(tmp_path):
    """Errors of the store and of the simulation are the work's, not the user's."""
    spec, out = tmp_path / "sweep.yaml", tmp_path / "out"
    spec.write_text(json.dumps(SPEC))
    run_sweep(SPEC | {"seed": 3}, out, simulator=FakeSimulator())
    result = CliRunner().invoke(main, ["sweep", str(spec), "--out", str(out)])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"nermo-mjx: {out} holds the results of another sweep: seed is 3 there and 0 here")
    assert result.stderr.count("\n") == 1


# --- interruptions


def test_what_is_computed_is_written_before_an_interruption_ends_it(tmp_path, monkeypatch):
    """A slow disk is waited for: three chunks were computed when Ctrl-C came, and three are there."""
    write = Store.write_chunk
    monkeypatch.setattr(Store, "write_chunk", lambda *args: (time.sleep(0.2), write(*args))[1])
    with pytest.raises(SweepInterrupted):
        run_sweep(SPEC, tmp_path, chunk=4, simulator=FakeSimulator(stop_at=3))
    assert len(list(tmp_path.glob("results/*.parquet"))) == 3


class Deaf(FakeSimulator):
    """Is interrupted in its third batch, and swallows it, as a destructor or a callback of JAX would."""

    def run(self, *args, **kwargs):
        if len(self.batches) == 2:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGTERM)
        return super().run(*args, **kwargs)


def test_an_interruption_that_something_swallows_still_counts(tmp_path):
    """The batch reports its progress, and that is the end."""
    with pytest.raises(SweepInterrupted):
        run_sweep(SPEC, tmp_path, chunk=4, simulator=Deaf())
    assert len(list(tmp_path.glob("results/*.parquet"))) == 2


def test_chunks_are_written_while_the_next_one_is_simulated(tmp_path, monkeypatch):
    """In another thread, one at a time, and never more than one behind."""
    write, threads, behind = Store.write_chunk, set(), []
    simulator = FakeSimulator()

    def slow(*args):
        """Takes until the next chunk has begun, and some time in which the one after that must not."""
        threads.add(threading.current_thread())
        until = time.monotonic() + 10.0
        while len(simulator.batches) < min(len(behind) + 2, 9) and time.monotonic() < until:
            time.sleep(0.001)
        time.sleep(0.03)
        behind.append(len(simulator.batches) - len(behind))
        return write(*args)

    monkeypatch.setattr(Store, "write_chunk", slow)
    run_sweep(SPEC, tmp_path, chunk=4, simulator=simulator)
    assert len(threads) == 1
    assert threads != {threading.main_thread()}
    assert max(behind) == 2  # the one that is written, and the next


@pytest.mark.parametrize("broken", [0, 8])
def test_an_error_of_the_writer_ends_the_sweep(tmp_path, monkeypatch, reference, broken):
    """While the next chunk but one is not begun yet, or at the end; what was computed by then is kept."""
    write, simulator = Store.write_chunk, FakeSimulator()

    def fails(store, chunk, *tables):
        if chunk == broken:
            raise DirectoryError("no room")
        write(store, chunk, *tables)

    with monkeypatch.context() as patch:
        patch.setattr(Store, "write_chunk", fails)
        with pytest.raises(DirectoryError, match="no room"):
            run_sweep(SPEC, tmp_path, chunk=4, simulator=simulator)
    assert len(simulator.batches) == min(broken + 2, 9)
    goes_on(tmp_path, reference, 9 - len(simulator.batches) + 1)


def kill_at_random(out, process, chance, startup):
    """Kill a sweep's process at a random moment: while it starts, or after it has written a chunk or two."""
    before, wanted, began = len(list(out.glob("results/*.parquet"))), chance.randrange(3), time.monotonic()
    while len(list(out.glob("results/*.parquet"))) < before + wanted:
        assert time.monotonic() - began < 100, "the sweep does not go on"
        time.sleep(0.001)
    time.sleep(chance.uniform(0.0, 0.03) if wanted else chance.uniform(0.0, startup))
    process.kill()


def test_kills_at_random_moments_lose_nothing(tmp_path, reference):
    """SIGKILL at a random moment: in the end the table is that of an undisturbed run."""
    context, chance = multiprocessing.get_context("forkserver"), random.Random(2)
    for _ in range(5):
        process = context.Process(target=sweep_fake.work, args=(tmp_path,), kwargs={"chunk": 1, "delay": 0.02})
        process.start()
        kill_at_random(tmp_path, process, chance, startup=0.5)
        process.join()
    kept = len(list(tmp_path.glob("results/*.parquet")))
    assert kept > 0
    goes_on(tmp_path, reference, 36 - kept)


@pytest.mark.long
def test_twenty_kills_of_the_command_lose_nothing(tmp_path):
    """Real walks in MuJoCo C: 20 SIGKILLs at random moments, then the table is equal to the undisturbed one's."""
    walks = {"vary": {"frequency": {"linspace": [0.6, 1.2, 120]}}, "run": {"cycles": 2, "warmup_cycles": 1}, "chunk": 1}
    spec, out, chance = tmp_path / "sweep.yaml", tmp_path / "out", random.Random(20)
    spec.write_text(json.dumps(walks | {"plots": False}))

    def command(folder):
        return [sys.executable, "-m", "nermo_mjx", "sweep", spec, "--out", folder, "--engine", "c", "--quiet"]

    subprocess.run(command(tmp_path / "undisturbed"), check=True)
    for _ in range(20):
        process = subprocess.Popen(command(out))
        kill_at_random(out, process, chance, startup=5.0)
        assert process.wait() == -signal.SIGKILL
    assert 0 < len(list(out.glob("results/*.parquet"))) < 120
    subprocess.run(command(out), check=True)
    table, undisturbed = read_table(out), read_table(tmp_path / "undisturbed")
    assert table.num_rows == 120
    for name in undisturbed.column_names:
        np.testing.assert_array_equal(table.column(name), undisturbed.column(name), strict=True, err_msg=name)


def test_a_second_process_is_refused_and_the_first_one_goes_on(tmp_path, reference):
    """One sentence for the second process while the first one is working."""
    context = multiprocessing.get_context("forkserver")
    process = context.Process(target=sweep_fake.work, args=(tmp_path,), kwargs={"chunk": 9, "delay": 0.5})
    process.start()
    waited = time.monotonic()
    while not list(tmp_path.glob("results/*.parquet")):
        assert time.monotonic() - waited < 60
        time.sleep(0.01)
    with pytest.raises(DirectoryError, match=rf"^another process works in {re.escape(str(tmp_path))}; wait for it, or"):
        run_sweep(SPEC, tmp_path, simulator=FakeSimulator())
    process.join(60)
    assert process.exitcode == 0
    assert read_table(Path(tmp_path)).equals(reference)


def test_a_lost_shard_is_named_by_the_others(tmp_path, reference):
    """The process that runs reports which chunks are missing, and the command that runs them."""
    result = run_sweep(SPEC, tmp_path, chunk=4, shard=(0, 3), simulator=FakeSimulator())
    result = run_sweep(SPEC, tmp_path, chunk=4, shard=(2, 3), simulator=FakeSimulator())
    assert (result.complete, result.rows_done, result.rows) == (False, 24, 36)
    assert result.missing == (
        "chunks 1, 4, 7 (12 runs) of 9 are missing; unless they are being run, run them with --shard 1/3."
    )
    assert run_sweep(SPEC, tmp_path, shard=(1, 3), simulator=FakeSimulator()).table.equals(reference)
