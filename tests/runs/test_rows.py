# Tests of runs/rows.py
"""The store of runs: found by content, atomic, undamaged or made again."""

from __future__ import annotations

import errno
import io
import itertools
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from fakes.sweep_fake import contents

from nermo_mjx import files as writing
from nermo_mjx.runs import CodeStamp, DirectoryError, OtherCode, RunDirectory
from nermo_mjx.runs.rows import Runs, keys_of, part_files, retire

STAMP = CodeStamp("1", "s", "m", "c", "3", "3", "0.8")


def keys(values):
    return keys_of("walk", {"a": np.asarray(values, float)}, len(values))


def opened(directory, group="aa", sources=(), **options):
    return Runs(directory.out, group, sources, directory=directory, **options)


def add(runs, values, first=0, series=False):
    rows = first + np.arange(len(values))
    metadata = {"engine": "c", "steps": "10", "wall_seconds": "2.0"}
    table = pa.table({"row": rows, "speed": np.asarray(values) * 2.0}).replace_schema_metadata(
        metadata
    )
    samples = pa.table({"row": np.repeat(rows, 2), "x": np.repeat(values, 2)}) if series else None
    return runs.add(keys(values), table, samples)


@pytest.fixture
def directory(tmp_path):
    with RunDirectory(tmp_path / "out", "sweep") as directory:
        yield directory


# --- found by content


def test_a_key_is_of_content_and_of_nothing_else():
    row_keys = keys_of("walk", {"b": np.array([1.0, np.nan]), "a": np.array([0.0, -0.0])}, 2)
    assert row_keys[0] == keys_of("walk", {"a": np.zeros(1), "b": np.ones(1)}, 1)[0]
    assert row_keys[1] == keys_of("walk", {"a": np.zeros(1)}, 1)[0]
    assert keys_of("other", {"a": np.zeros(1)}, 1)[0] != row_keys[1]
    assert (
        keys_of("walk", {"a": np.full(1, 0.1)}, 1)[0]
        != keys_of("walk", {"a": np.full(1, 0.1 + 1e-16)}, 1)[0]
    )


def test_runs_are_found_again_in_any_order_and_by_another_job(directory):
    add(opened(directory), [1.0, 2.0])
    add(opened(directory), [3.0], first=2)
    assert sorted(opened(directory).row_numbers.tolist()) == [0, 1, 2]
    second_job = opened(directory, "bb")  # extended: the same folder, another job
    assert len(second_job.row_numbers) == 0
    places = second_job.find(keys([3.0, 9.0, 1.0]))
    assert (places >= 0).tolist() == [True, False, True]
    rows = second_job.take(places[places >= 0])
    assert rows.column("speed").to_pylist() == [6.0, 2.0]
    assert rows.schema.metadata[b"steps"] == b"15.0"  # the whole of one part, half of the other


def test_parts_of_another_job_leave_the_folder_that_is_read_whole_and_come_back(directory):
    first = add(opened(directory, series=True), [1.0], series=True)
    runs = opened(directory, "bb", series=True)
    places = runs.find(keys([1.0]))
    runs.take_codes([STAMP], accept=True)
    assert runs.take(places)["speed"].to_pylist() == [2.0], "also after they were moved"
    second = add(runs, [2.0])
    assert [path.name for path in part_files(directory.out)] == [second.path.name]
    assert not first.series.is_relative_to(directory.out / "series")
    assert len(list(directory.out.glob("former/*/*.parquet"))) == 2
    runs = opened(directory, series=True)
    assert runs.row_numbers.tolist() == [0]
    assert first.path.exists()


@pytest.mark.parametrize("move_number", [0, 1, 2])
def test_a_process_killed_while_it_moves_parts_loses_none(directory, monkeypatch, move_number):
    """Of runs and of their series, which are moved one after the other: both jobs find all of them."""
    add(opened(directory), [1.0], series=True)
    moves, rename = itertools.count(), Path.rename

    def killed(path, target):
        if next(moves) == move_number:
            raise KeyboardInterrupt
        return rename(path, target)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", killed)
        if move_number < 2:
            with pytest.raises(KeyboardInterrupt):
                retire(directory, "bb")
        else:
            retire(directory, "bb")
    for group in ("bb", "aa"):
        warned = []
        runs = opened(directory, group, series=True, warn=warned.append)
        (index,) = runs.find(keys([1.0]))
        assert [
            series_table["x"].to_pylist() for series_table in runs.series(np.array([index]))
        ] == [[1.0, 1.0]]
        assert warned == []


def test_another_directory_is_only_read(directory, tmp_path):
    with RunDirectory(tmp_path / "there", "sweep") as other_directory:
        store = opened(other_directory)
        store.take_codes([STAMP], accept=False)
        path = add(store, [1.0], series=True).path
    runs = opened(directory, sources=[tmp_path / "there"], series=True)
    (index,) = runs.find(keys([1.0]))
    assert runs.take(np.array([index])).column("speed").to_pylist() == [2.0]
    assert [
        series_table.column("x").to_pylist() for series_table in runs.series(np.array([index]))
    ] == [[1.0, 1.0]]
    assert runs.codes(accept=False) == [STAMP]
    path.write_bytes(path.read_bytes()[:-1])
    warned = []
    assert opened(directory, sources=[tmp_path / "there"], warn=warned.append).find(
        keys([1.0])
    ).tolist() == [-1]
    assert path.exists()
    assert str(path) in warned[0]


def test_without_the_directory_nothing_is_written(tmp_path):
    """As a forecast asks: neither folders nor what is damaged change."""
    assert len(Runs(tmp_path / "none", "aa").row_numbers) == 0
    assert not (tmp_path / "none").exists()
    with RunDirectory(tmp_path / "out", "sweep") as directory:
        path = add(opened(directory), [1.0]).path
        retire(directory, "bb")
        add(opened(directory, "bb"), [2.0])
    retired_path = next(tmp_path.glob("out/former/results/*"))
    retired_path.write_bytes(b"half")
    former_contents = contents(tmp_path)
    warned = []
    assert len(Runs(tmp_path / "out", "aa", warn=warned.append).row_numbers) == 0
    assert warned == [f"{retired_path} is damaged; its runs are not used."]
    assert former_contents == contents(tmp_path)
    assert not path.exists()


def test_runs_of_unknown_code_are_used_only_when_that_is_accepted(directory, tmp_path):
    with RunDirectory(tmp_path / "there", "sweep") as other_directory:
        add(opened(other_directory), [1.0])
    runs = opened(directory, sources=[tmp_path / "there"])
    with pytest.raises(
        OtherCode,
        match="there does not say which code made it: its runs are used with --accept-new",
    ):
        runs.codes(accept=False)
    assert runs.codes(accept=True) == []


# --- faults


def test_any_damage_is_seen_and_nothing_is_deleted(directory):
    """A flipped byte of pages, footer, its length, the letters at both ends, of runs and of series; a file that is cut,
    or another part's: its name has its content's digest, not only a valid Parquet file counts."""
    runs = opened(directory, series=True)
    part = add(runs, [1.0, 2.0], series=True)
    second_part = add(runs, [3.0], first=2, series=True)
    for file, instead in ((part.path, second_part.path), (part.series, second_part.series)):
        content = file.read_bytes()
        flips = [
            (position, content[position] ^ 1 << (position % 8))
            for position in [*range(0, len(content), 41), len(content) - 1]
        ]
        wrong = [
            content[:position] + bytes([flipped]) + content[position + 1 :]
            for position, flipped in flips
        ]
        wrong += [content[:cut] for cut in (0, 1, 7, 8, 100, -1, -200)]
        for damaged in [*wrong, instead.read_bytes()]:
            file.write_bytes(damaged)
            warned = []
            runs = opened(directory, series=True, warn=warned.append)
            assert runs.row_numbers.tolist() == [2], damaged
            assert [str(part.path) in message for message in warned] == [True]
            assert damaged in [path.read_bytes() for path in directory.out.glob("*.aside/*")]
            add(runs, [1.0, 2.0], series=True)
            assert sorted(opened(directory, series=True).row_numbers.tolist()) == [0, 1, 2]
            for path in directory.out.glob("*.aside/*"):
                path.unlink()


class FullDisk(io.FileIO):
    """A file on a disk with room for half of what is written to it."""

    def write(self, content):
        super().write(content[: len(content) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("folder", ["series", "results"])
def test_a_full_disk_leaves_nothing_half_written(directory, monkeypatch, folder):
    """Whether the series or the runs have no room: the runs are not there, and all others are."""
    runs = opened(directory, series=True)
    add(runs, [1.0], series=True)
    with monkeypatch.context() as patch:

        def opens(path, mode):
            return FullDisk(path, mode) if path.parent.name == folder else open(path, mode)

        patch.setattr(writing, "open", opens, raising=False)
        with pytest.raises(
            DirectoryError, match=r"No space left on device\. What is finished is kept"
        ):
            add(runs, [2.0], first=1, series=True)
    assert not list(directory.out.rglob("*.nermo-tmp"))
    runs = opened(directory, series=True)
    assert runs.row_numbers.tolist() == [0]
    assert len(list(directory.out.glob("series/*"))) == 1
    add(runs, [2.0], first=1, series=True)
    assert sorted(opened(directory, series=True).row_numbers.tolist()) == [0, 1]


@pytest.mark.parametrize("operation", ["rename", "bytes"])
def test_what_a_disk_loses_is_missing_when_it_is_looked_at_again(directory, monkeypatch, operation):
    replace = os.replace

    def loses(source, target):
        if operation == "rename":
            os.unlink(source)
        else:
            Path(source).write_bytes(Path(source).read_bytes()[:-1])
            replace(source, target)

    runs = opened(directory)
    with monkeypatch.context() as patch:
        patch.setattr(os, "replace", loses)
        add(runs, [1.0])
    assert len(runs.row_numbers) == 1
    runs.survey()
    assert len(runs.row_numbers) == 0


CHILD = """
import sys, numpy as np; sys.path[:0] = sys.argv[2].split()
from test_rows import *
shard = (int(sys.argv[3]), 3) if len(sys.argv) > 3 else None
with RunDirectory(sys.argv[1], "sweep", shard) as directory:
    runs = opened(directory, series=True)
    done = set(runs.row_numbers.tolist())
    for i in range(shard[0] if shard else 0, 300, 3 if shard else 1):
        if i not in done:
            add(runs, [float(i)], first=i, series=True)
            print(i, flush=True)
"""


def child(out, *shard):
    folders = f"{Path(__file__).parent} {Path(__file__).parents[1]}"
    words = [sys.executable, "-c", CHILD, str(out), folders, *map(str, shard)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


@pytest.mark.release
def test_what_killed_processes_stored_is_whole(tmp_path):
    """Three times, at other moments, in one directory: all that they said to be stored is there, undamaged."""
    output_lines, chance = [], random.Random(1)
    for round_ in range(3):
        process = child(tmp_path)
        output_lines += [process.stdout.readline() for _ in range(5 + round_)]
        time.sleep(chance.uniform(0.0, 0.01))
        process.send_signal(signal.SIGKILL)
        output_lines += process.stdout.readlines()
        process.wait()
    with RunDirectory(tmp_path, "sweep") as directory:
        warned = []
        rows = opened(directory, warn=warned.append, series=True).row_numbers.tolist()
    assert not warned
    assert sorted(rows) == list(range(len(rows)))
    assert set(rows) >= {int(line) for line in output_lines if line.endswith("\n")}


@pytest.mark.release
def test_shards_add_at_the_same_time(tmp_path):
    """Three processes, of which one is killed and begun again; a fourth one alone is refused meanwhile."""
    processes = [child(tmp_path, i) for i in range(3)]
    processes[1].stdout.readline()
    with (
        pytest.raises(DirectoryError, match="another process works in"),
        RunDirectory(tmp_path, "sweep"),
    ):
        pass
    processes[1].kill()
    processes[1].wait()
    processes.append(child(tmp_path, 1))
    for process in processes:
        process.communicate(timeout=60)
    with RunDirectory(tmp_path, "sweep") as directory:
        warned = []
        assert sorted(
            opened(directory, warn=warned.append, series=True).row_numbers.tolist()
        ) == list(range(300))
        assert warned == []
    assert len(list(tmp_path.glob("series/*"))) == len(list(tmp_path.glob("results/*"))) == 300
