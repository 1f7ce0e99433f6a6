# Tests of sweep/simulating.py
"""Sweeps of any size: chunks that fit the machine, rows created on demand, and constant memory."""

import gc
import itertools
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from fakes.sweep_fake import SPEC, FakeSimulator

from nermo_mjx.rollout import METRICS
from nermo_mjx.sweep import Sweep, read_table, run_sweep, sample
from nermo_mjx.sweep.simulating import BUSY_WORLDS, ENGINE_WORLD_BYTES, chunk_rows
from nermo_mjx.sweep.spec import Sample
from nermo_mjx.sweep.table import summarize

GIB = 2**30


# --- chunks


def test_a_chunk_in_c_grows_with_the_cores_and_slowly_with_the_sweep():
    """32 rows a core; above ten thousand chunks more, but never more than ten times as many."""
    assert chunk_rows("c", 10_000, cores=2) == 64
    assert chunk_rows("c", 10_000, cores=16) == 512
    assert chunk_rows("c", 1_000_000, cores=2) == 100
    assert chunk_rows("c", 10_000_000, cores=2) == 640
    assert chunk_rows("mjx", 10_000, memory=None, cores=2) == 64  # the CPU as JAX's device


def test_a_small_sweep_is_divided_among_all_processes():
    """Each of four gets a chunk, on whichever engine."""
    assert chunk_rows("c", 240, cores=64, parts=4) == 60
    assert chunk_rows("mjx", 240, memory=80 * GIB, parts=4) == 60
    assert chunk_rows("c", 1, cores=64, parts=4) == 1


@pytest.mark.parametrize("gibibytes", [1, 2, 4, 8, 16, 80, 140])
@pytest.mark.parametrize("devices", [1, 2, 3, 8])
@pytest.mark.parametrize("rows", [5, 1000, 10_000_000])
@pytest.mark.parametrize("engine", ["mjx", "warp"])
def test_a_chunk_on_devices_fits_their_memory_and_divides_among_them(
    gibibytes, devices, rows, engine
):
    """Half of each device's memory at most, the same number of worlds on each, none of them idle for want of rows."""
    size = chunk_rows(engine, rows, memory=gibibytes * GIB, devices=devices, cores=16)
    assert size % devices == 0
    assert size // devices * ENGINE_WORLD_BYTES[engine] <= gibibytes * GIB / 2
    assert size - devices < rows
    if rows == 10_000_000:
        assert size // devices == min(
            BUSY_WORLDS, int(gibibytes * GIB / 2 / ENGINE_WORLD_BYTES[engine])
        )


def test_the_memory_of_a_world_is_what_was_measured_last():
    """In the benchmarks of this repository: enough for every batch, and not twice as much."""
    runs = (
        (Path(__file__).parents[2] / "docs" / "benchmarks" / "gpu_plan.jsonl")
        .read_text()
        .splitlines()
    )
    newest = {
        tuple(line[key] for key in ("target", "program", "worlds")): line["bytes_per_world"]
        for run in runs
        for line in json.loads(run)["cases"]
    }
    largest = max(needed for (_, program, _), needed in newest.items() if program == "walk")
    assert largest <= ENGINE_WORLD_BYTES["mjx"] < 2 * largest


def test_a_device_with_no_memory_left_still_gets_a_world():
    """One for each device is the least there is."""
    assert chunk_rows("mjx", 100, memory=1000, devices=4) == 4


def test_the_size_in_the_file_and_of_the_caller_come_first(tmp_path):
    """`chunk:` in the sweep file, and above it the argument."""
    for name, chunk, expected in (("file", None, [6] * 6), ("caller", 9, [9] * 4)):
        simulator = FakeSimulator()
        run_sweep(SPEC | {"chunk": 6}, tmp_path / name, chunk=chunk, simulator=simulator)
        assert simulator.batches == expected


# --- rows


SPECS = {
    "grid": {"vary": {"frequency": [0.5, 1.0, 0.7], "duty": [0.4, 0.5]}},
    "repeats": {
        "vary": {"duty": [0.4, 0.5, 0.6]},
        "randomize": {"repeats": 3, "frequency": {"uniform": [0.6, 0.9]}},
    },
    "sobol": {
        "vary": {"frequency": {"uniform": [0.5, 1.5]}, "duty": {"uniform": [0.4, 0.6]}},
        "sample": {"sobol": 9},
    },
    "bodies": {
        "randomize": {"repeats": 8, "from": "identified"},
        "vary": {"frequency": [0.5, 0.6]},
    },
    "only chance": {"randomize": {"repeats": 4, "contact.friction": {"uniform": [1.0, 1.6]}}},
}


@pytest.mark.parametrize("spec", SPECS.values(), ids=SPECS)
def test_a_row_is_the_same_whichever_rows_are_asked_for(spec):
    """Some rows, in any order, and a column of all, are those of the whole."""
    sweep = Sweep.from_dict(spec)
    lazy, whole = Sample(sweep), sample(sweep)
    index = np.random.default_rng(0).permutation(len(lazy))[: len(lazy) - 1]
    assert len(lazy) == len(whole)
    for some in (lazy.take(index), whole.take(index)):
        assert len(some) == len(index)
        for name in ("variant", "repeat", "seed", "structure"):
            np.testing.assert_array_equal(getattr(some, name), getattr(whole, name)[index])
        assert (some.body is None) == (whole.body is None)
        np.testing.assert_array_equal(some.body, None if whole.body is None else whole.body[index])
        for name, values in whole.values.items():
            np.testing.assert_array_equal(some.values[name], values[index])
            np.testing.assert_array_equal(lazy.column(name), values)


def test_a_grid_of_ten_million_rows_takes_no_memory():
    """Rows at its end are there at once, and are those of the product."""
    axes = {"frequency": 100, "duty": 100, "stride": 100, "spine.amplitude": 10}

    def ending(axes):
        vary = {name: {"linspace": [0.3, 0.4, count]} for name, count in axes.items()}
        rows = Sample(Sweep.from_dict({"spine": "stride_extension", "vary": vary}))
        return rows, rows.take(np.arange(len(rows) - 3, len(rows)))

    ending(
        dict.fromkeys(axes, 2)
    )  # what the first sweep of a process imports and compiles does not count
    tracemalloc.start()
    rows, last = ending(axes)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(rows) == 10_000_000
    assert last.values["spine.amplitude"].tolist() == pytest.approx(
        [0.3 + 0.1 * i / 9 for i in (7, 8, 9)]
    )
    assert last.values["frequency"].tolist() == [0.4] * 3
    assert peak < 4_000_000


# --- memory


class Measuring(FakeSimulator):
    """Has all metrics; notes what Python and Arrow hold when the 10th and the 40th batch come in."""

    def __init__(self):
        super().__init__()
        self.held = []

    def run(self, *args, **kwargs):
        if len(self.batches) in (10, 39):
            gc.collect()
            self.held.append(tracemalloc.get_traced_memory()[0] + pa.total_allocated_bytes())
        result = super().run(*args, **kwargs)
        result.metrics = dict.fromkeys(METRICS, result.metrics["speed"] + 0.0)
        return result


@pytest.mark.long
@pytest.mark.release
def test_finished_chunks_are_not_kept_in_memory(tmp_path):
    """Over thirty chunks, memory grows by less than five of their tables would take."""
    spec = {
        "vary": {"frequency": {"linspace": [0.5, 1.0, 400]}, "duty": {"linspace": [0.4, 0.6, 10]}},
        "plots": False,
    }
    simulator = Measuring()
    tracemalloc.start()
    result = run_sweep(spec, tmp_path, chunk=100, simulator=simulator)
    tracemalloc.stop()
    early, late = simulator.held
    assert late - early < result.table.nbytes / 40 * 5


@pytest.mark.release
def test_a_table_that_does_not_fit_is_read_column_by_column(tmp_path, monkeypatch):
    """The summary and the figures of a sweep are the same where only one column fits into memory at a time."""
    spec = SPEC | {
        "plots": True,
        "randomize": {"repeats": 2, "contact.friction": {"uniform": [1.0, 1.6]}},
    }
    usual = run_sweep(spec, tmp_path, chunk=5, simulator=FakeSimulator(falls_above=0.11))
    figures = [path.read_bytes() for path in usual.plots]
    monkeypatch.setattr("nermo_mjx.sweep.table.MAX_HELD_NUMBERS", 1)
    frugal = run_sweep(spec, tmp_path, simulator=FakeSimulator())
    assert frugal.chunks_run == 0
    assert frugal.summary == usual.summary
    assert [path.read_bytes() for path in frugal.plots] == figures
    of_table = summarize(read_table(tmp_path))
    assert of_table == {name: usual.summary[name] for name in of_table}
    assert set(itertools.chain(usual.summary["status"])) == {"ok", "fell"}
