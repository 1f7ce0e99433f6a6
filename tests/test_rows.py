"""The store of runs: found by content, atomic, undamaged or made again."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time

import numpy as np
import pyarrow as pa
import pytest

from nermo_mjx.runs import CodeStamp, DirectoryError, OtherCode, RunDirectory
from nermo_mjx.runs.rows import Runs, keys_of, part_files

STAMP = CodeStamp("1", "s", "m", "c", "3", "3", "0.8")


def keys(values):
    return keys_of("walk", {"a": np.asarray(values, float)}, len(values))


def add(runs, values, first=0, series=False):
    rows = first + np.arange(len(values))
    about = {"engine": "c", "steps": "10", "wall_seconds": "2.0"}
    table = pa.table({"row": rows, "speed": np.asarray(values) * 2.0}).replace_schema_metadata(about)
    return runs.add(keys(values), table, pa.table({"row": np.repeat(rows, 2), "x": np.repeat(values, 2)})
                    if series else None)  # fmt: skip


@pytest.fixture
def held(tmp_path):
    with RunDirectory(tmp_path / "out", "sweep") as held:
        yield held


def test_a_key_is_of_content_and_of_nothing_else():
    both = keys_of("walk", {"b": np.array([1.0, np.nan]), "a": np.array([0.0, -0.0])}, 2)
    assert both[0] == keys_of("walk", {"a": np.zeros(1), "b": np.ones(1)}, 1)[0]
    assert both[1] == keys_of("walk", {"a": np.zeros(1)}, 1)[0]
    assert keys_of("other", {"a": np.zeros(1)}, 1)[0] != both[1]
    assert keys_of("walk", {"a": np.full(1, 0.1)}, 1)[0] != keys_of("walk", {"a": np.full(1, 0.1 + 1e-16)}, 1)[0]


def test_runs_are_found_again_in_any_order_and_by_another_job(held):
    add(Runs(held, "aa"), [1.0, 2.0])
    again = Runs(held, "aa")
    add(again, [3.0], first=2)
    assert sorted(Runs(held, "aa").column("row").tolist()) == [0, 1, 2]
    other = Runs(held, "bb")  # extended: the same folder, another job
    assert len(other.column("row")) == 0
    places = other.find(keys([3.0, 9.0, 1.0]))
    assert (places >= 0).tolist() == [True, False, True]
    found = other.take(places[places >= 0])
    assert found.column("speed").to_pylist() == [6.0, 2.0]
    assert found.schema.metadata[b"steps"] == b"15.0"  # the whole of one part, half of the other


def test_parts_of_another_job_leave_the_folder_that_is_read_whole_and_come_back(held):
    first = add(Runs(held, "aa"), [1.0], series=True)
    second = add(Runs(held, "bb"), [2.0])
    assert [path.name for path in part_files(held.out)] == [second.path.name]
    assert not first.series.exists()
    runs = Runs(held, "aa", series=True)
    assert runs.column("row").tolist() == [0]
    assert (runs.find(keys([1.0])) >= 0).all()
    assert len(list(held.out.glob("former/results/*"))) == 1


def test_another_directory_is_only_read(held, tmp_path):
    with RunDirectory(tmp_path / "there", "sweep") as there:
        store = Runs(there, "aa")
        store.take_codes([STAMP], accept=False)
        path = add(store, [1.0], series=True).path
    runs = Runs(held, "aa", [tmp_path / "there"], series=True)
    (place,) = runs.find(keys([1.0]))
    assert runs.take(np.array([place])).column("speed").to_pylist() == [2.0]
    assert [each.column("x").to_pylist() for each in runs.series(np.array([place]))] == [[1.0, 1.0]]
    assert runs.codes(accept=False) == [STAMP]
    path.write_bytes(path.read_bytes()[:-1])
    said = []
    assert Runs(held, "aa", [tmp_path / "there"], said.append).find(keys([1.0])).tolist() == [-1]
    assert path.exists()
    assert str(path) in said[0]


@pytest.mark.parametrize("where", range(0, 1000, 90))
def test_a_flipped_bit_anywhere_is_seen_and_nothing_is_deleted(held, where):
    part = add(Runs(held, "aa"), [1.0, 2.0])
    add(Runs(held, "aa"), [3.0], first=2)
    content = bytearray(part.path.read_bytes())
    content[where * len(content) // 1000] ^= 1
    part.path.write_bytes(bytes(content))
    said = []
    runs = Runs(held, "aa", warn=said.append)
    assert runs.column("row").tolist() == [2]
    assert str(part.path) in said[0]
    assert [path.read_bytes() for path in (held.out / "results.aside").iterdir()] == [bytes(content)]
    add(runs, [1.0, 2.0])
    assert (Runs(held, "aa").find(keys([1.0, 2.0, 3.0])) >= 0).all()


def test_runs_without_their_series_are_missing(held):
    part = add(Runs(held, "aa", series=True), [1.0], series=True)
    assert len(Runs(held, "aa", series=True).parts) == 1
    part.series.unlink()
    assert len(Runs(held, "aa", series=True).parts) == 0


def test_a_full_disk_leaves_nothing_half_written(held, monkeypatch):
    runs = Runs(held, "aa")
    add(runs, [1.0])

    def full(_):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(os, "fsync", full)
        with pytest.raises(DirectoryError, match="No space left"):
            add(runs, [2.0], first=1)
    assert [path.name for path in (held.out / "results").iterdir()] == [path.name for path in part_files(held.out)]
    assert Runs(held, "aa").column("row").tolist() == [0]


def test_other_code_is_refused(held):
    runs = Runs(held, "aa")
    runs.take_codes([STAMP], accept=False)
    add(runs, [1.0])
    changed = CodeStamp("1", "s2", "m", "c", "3", "3", "0.8")
    with pytest.raises(OtherCode, match="s, not s2"):
        Runs(held, "aa").take_codes([changed], accept=False)
    Runs(held, "aa").take_codes([changed], accept=True)


CHILD = """
import sys, numpy as np; sys.path.insert(0, sys.argv[2])
from test_rows import *
with RunDirectory(sys.argv[1], "sweep") as held:
    runs = Runs(held, "aa")
    for i in range(10000):
        add(runs, [float(i)], first=i, series=True)
        print(i, flush=True)
"""


def test_what_a_killed_process_stored_is_whole(tmp_path):
    for round_ in range(3):
        out = tmp_path / str(round_)
        child = subprocess.Popen([sys.executable, "-c", CHILD, str(out), os.path.dirname(__file__)],
                                 stdout=subprocess.PIPE, text=True)  # fmt: skip
        said = [child.stdout.readline() for _ in range(5 + round_)]
        time.sleep(0.003 * round_)
        child.send_signal(signal.SIGKILL)
        said += child.stdout.readlines()
        child.wait()
        with RunDirectory(out, "sweep") as held:
            warned = []
            rows = sorted(Runs(held, "aa", warn=warned.append, series=True).column("row").tolist())
        assert not warned
        assert rows == list(range(len(rows)))
        assert len(rows) >= len([line for line in said if line.endswith("\n")])
