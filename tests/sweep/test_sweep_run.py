# Tests of sweep/run.py, runs/work.py
"""Running a sweep: resuming, chunks, shards, interruption, and the summary."""

import dataclasses
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from command import call
from fakes.sweep_fake import AMPLITUDES, FREQUENCIES, SPEC, FakeSimulator, speed

from nermo_mjx.robot import identified
from nermo_mjx.runs import Interrupted, Watch
from nermo_mjx.sweep import SpecError, Sweep, read_table, run_sweep
from nermo_mjx.sweep.table import meta


@pytest.fixture(scope="module")
def reference(tmp_path_factory):
    """The sweep run without a stop."""
    return run_sweep(SPEC, tmp_path_factory.mktemp("sweep"), simulator=FakeSimulator())


def stop_half_way(tmp_path, number):
    """Start a sweep in a process, send it a signal in its fourth chunk; its directory, log and process."""
    out, log = tmp_path / "out", tmp_path / "log"
    script = Path(__file__).parents[1] / "fakes" / "sweep_fake.py"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    process = subprocess.Popen(
        [sys.executable, script, out, log], stdout=subprocess.PIPE, text=True, env=environment
    )
    waited = time.monotonic()
    while (log.read_text().count("\n") if log.exists() else 0) < 4:
        assert process.poll() is None, "the sweep ended too early"
        assert time.monotonic() - waited < 60
        time.sleep(0.01)
    process.send_signal(number)
    printed, _ = process.communicate(timeout=30)
    return out, process.returncode, printed


@pytest.mark.release
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_a_stopped_sweep_goes_on_and_gives_the_same_table(tmp_path, reference, number):
    """Killed in its fourth chunk, a sweep keeps the first two; only of the third the writing may not be over."""
    out, code, printed = stop_half_way(tmp_path, number)
    if number == signal.SIGTERM:
        assert code == 3
        assert f"nermo-mjx sweep {out}/sweep.yaml --out {out}" in printed
    part_count = len(list(out.glob("results/*.parquet")))
    assert part_count in ((2, 3) if number == signal.SIGKILL else (3,))
    assert not (out / "summary.json").exists()
    simulator = FakeSimulator()
    result = run_sweep(out / "sweep.yaml", out, simulator=simulator)
    assert simulator.batches == [4] * (9 - part_count)
    assert result.table.equals(reference.table)
    assert result.table.to_pydict() == reference.table.to_pydict()
    assert len(json.loads((out / "run.json").read_text())["sessions"]) == 2


def test_ctrl_c_says_how_to_go_on(tmp_path, reference):
    """KeyboardInterrupt leaves finished chunks and an instruction; the same call resumes."""
    with pytest.raises(Interrupted, match=r"run the same command again, or: nermo-mjx sweep"):
        run_sweep(SPEC, tmp_path, chunk=10, simulator=FakeSimulator(stop_at=2))
    simulator = FakeSimulator()
    assert run_sweep(SPEC, tmp_path, chunk=10, simulator=simulator).table.equals(reference.table)
    assert simulator.batches == [9, 9]
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.parametrize("chunk", [1, 5, 36, 1000])
def test_the_table_does_not_depend_on_the_chunks(tmp_path, reference, chunk):
    """Rows come in the order of the sweep, with the same content, however they were cut."""
    spec = SPEC | {"randomize": {"repeats": 2}} if chunk == 5 else SPEC
    result = run_sweep(spec, tmp_path, chunk=chunk, simulator=FakeSimulator())
    if chunk == 5:
        again = run_sweep(spec, tmp_path / "other", chunk=7, simulator=FakeSimulator())
        assert result.table.equals(again.table)
    else:
        assert result.table.equals(reference.table)
    assert result.table.column("row").to_pylist() == list(range(result.table.num_rows))


def test_all_chunks_have_one_shape(tmp_path):
    """36 rows in chunks of at most 10 are four batches of 9; 35 rows are padded to one shape, so nothing recompiles."""
    simulator = FakeSimulator()
    run_sweep(SPEC, tmp_path / "a", chunk=10, simulator=simulator)
    assert simulator.batches == [9, 9, 9, 9]
    simulator = FakeSimulator()
    spec = {"plots": False, "vary": {"frequency": {"linspace": [0.4, 1.2, 35]}}}
    result = run_sweep(spec, tmp_path / "b", chunk=10, simulator=simulator)
    assert simulator.batches == [9, 9, 9, 9]
    frequency = result.table.column("frequency").to_numpy()
    np.testing.assert_allclose(frequency, np.linspace(0.4, 1.2, 35))
    np.testing.assert_allclose(result.table.column("speed").to_numpy(), speed(frequency), rtol=1e-6)


def test_chunk_mates_last_alike_long(tmp_path):
    """Rows are cut by simulated time: a chunk does not wait for one slow gait among fast ones."""
    run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator())
    tables = [pq.read_table(path) for path in sorted(tmp_path.glob("results/*.parquet"))]
    spans = [set(table.column("frequency").to_pylist()) for table in tables]
    assert sorted(spans, key=min) == [{0.5}, {0.7}, {0.9}, {1.1}]


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"shard": (2, 2)}, "shard is 2/2"),
        ({"chunk": 0}, "chunk is 0"),
        ({"extend": True, "shard": (0, 2)}, "start it on its own"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(tmp_path, given, message):
    """Shard and chunk outside their range are the user's error."""
    with pytest.raises(SpecError, match=message):
        run_sweep(SPEC, tmp_path / "out", simulator=FakeSimulator(), **given)
    assert not (tmp_path / "out").exists()


def test_progress_grows_to_one_and_counts_what_was_resumed(tmp_path):
    """A resumed sweep starts where it was; the fraction never falls."""
    with pytest.raises(Interrupted):
        run_sweep(SPEC, tmp_path, chunk=9, simulator=FakeSimulator(stop_at=2))
    seen = []
    run_sweep(SPEC, tmp_path, simulator=FakeSimulator(), watch=Watch(seen.append))
    fractions = [report.fraction for report in seen]
    assert fractions == sorted(fractions)
    assert fractions[0] > 0
    assert fractions[-1] == pytest.approx(1.0)
    assert (seen[0].resumed, seen[0].total, seen[-1].done) == (18, 36, 36)
    assert len(set(fractions)) > 4  # within chunks, too


def test_run_json_tells_how_to_do_it_again(tmp_path):
    """Command, versions and machine of the session are noted."""
    run_sweep(SPEC, tmp_path, simulator=FakeSimulator())
    session = json.loads((tmp_path / "run.json").read_text())["sessions"][0]
    assert session["versions"]["mujoco"] == mujoco.__version__
    assert session["machine"]["cores"] >= 1
    assert session["command"]


def test_the_summary_says_what_the_closed_form_says(reference):
    """Best variant, means over one parameter, gain over the stiff spine: compared with the fake robot's formula."""
    summary = json.loads((reference.out / "summary.json").read_text())
    assert summary["rows"] == summary["variants"] == 36
    assert summary["status"] == {"ok": 36}
    best = summary["best"]["speed"]
    assert best["parameters"] == {"frequency": 1.1, "spine.amplitude": 0.4, "spine.phase": 0.0}
    assert best["mean"] == pytest.approx(speed(1.1, 0.4, 0.0), rel=1e-6)
    grid = np.meshgrid(FREQUENCIES, AMPLITUDES, (-1.0, 0.0, 1.0), indexing="ij")
    for line, mean in zip(
        summary["marginal_means"]["frequency"], speed(*grid).mean(axis=(1, 2)), strict=True
    ):
        assert line["speed"] == pytest.approx(mean, rel=1e-6)
    assert [line["frequency"] for line in summary["spine_gain"]] == list(FREQUENCIES)
    for line in summary["spine_gain"]:
        assert line["best"]["ratio"] == pytest.approx(1.2, rel=1e-6)
        assert line["best"]["parameters"] == {"spine.amplitude": 0.4, "spine.phase": 0.0}
        assert line["worst"]["ratio"] == pytest.approx(1 + 0.1 * np.cos(1.0), rel=1e-6)
    assert summary["rank_correlations"]["frequency"] > 0.9
    assert summary["engine"] == "fake"
    assert summary["steps"] == 3600


def test_repeats_are_averaged_and_their_spread_is_given(tmp_path):
    """The best variant's mean and standard deviation are those of its repeats in the table."""
    result = run_sweep(
        {"vary": {"frequency": [0.5, 0.9]}, "randomize": {"repeats": 5}},
        tmp_path,
        simulator=FakeSimulator(),
    )
    best = result.summary["best"]["speed"]
    speeds = result.table.column("speed").to_numpy()[result.table.column("variant").to_numpy() == 1]
    assert best["runs"] == 5
    assert best["mean"] == pytest.approx(speeds.mean())
    assert best["std"] == pytest.approx(speeds.std(ddof=1))
    assert best["std"] > 1e-5


def test_fallen_robots_win_nothing(tmp_path):
    """Runs that fell are counted and kept in the table, but no best, mean or gain is theirs."""
    result = run_sweep(SPEC, tmp_path, simulator=FakeSimulator(falls_above=0.1))
    assert (
        result.summary["status"]["fell"]
        == np.sum(result.table.column("speed").to_numpy() > 0.1)
        > 0
    )
    assert result.summary["best"]["speed"]["mean"] <= 0.1
    assert result.summary["metrics"]["speed"]["max"] <= 0.1


class Falling(FakeSimulator):
    """Faster than 0.9 Hz is fast, and loses all repeats but the first: they fall, diverge, or have no number."""

    def __init__(self, how):
        super().__init__()
        self.how = how

    def run(self, values, run, **options):
        result = super().run(values, run, **options)
        lost = (values["frequency"] > 0.9) & (values["start.x"] != 0)
        if self.how == "no number":
            result.metrics["speed"] = np.where(lost, np.nan, result.metrics["speed"])
        else:
            result.metrics[self.how] = lost.astype(float)
            result.status = np.where(lost, self.how, "ok")
        return result


@pytest.mark.parametrize("how", ["fell", "diverged", "no number"])
def test_a_variant_with_lost_runs_is_not_best_before_one_without(tmp_path, how):
    """Beside each mean stands the share that is lost and why, and the spread of one run is unknown, not 0."""
    spec = {"vary": {"frequency": [0.5, 0.7, 1.0]}, "randomize": {"repeats": 4}, "plots": False}
    run_sweep(spec, tmp_path / "three", simulator=Falling(how))
    summary = json.loads((tmp_path / "three" / "summary.json").read_text())
    best = summary["best"]["speed"]
    assert (best["parameters"], best["runs"], best["lost"], best["why"]) == (
        {"frequency": 0.7},
        4,
        0.0,
        {},
    )
    assert best["low"] < best["mean"] < best["high"]
    half = 3.182 * best["std"] / 2  # Student's t with 3 degrees of freedom
    assert best["high"] - best["mean"] == pytest.approx(half, rel=1e-3)
    assert [line["lost"] for line in summary["marginal_means"]["frequency"]] == [0.0, 0.0, 0.75]
    assert summary["metrics"]["speed"]["lost"] == 0.25
    run_sweep(spec | {"vary": {"frequency": [1.0]}}, tmp_path / "one", simulator=Falling(how))
    alone = json.loads((tmp_path / "one" / "summary.json").read_text())["best"]["speed"]
    assert (alone["std"], alone["low"], alone["runs"], alone["lost"]) == (None, None, 1, 0.75)
    assert alone["why"] == {how: 3}
    output = call("sweep", tmp_path / "one" / "sweep.yaml", "--out", tmp_path / "one").stdout
    assert re.search(
        rf"mean ± 95 % interval.*\n.*\n *speed +max +100 +mm/s +75 % \(3 {how}\)", output
    )
    output = call("sweep", tmp_path / "three" / "sweep.yaml", "--out", tmp_path / "three").stdout
    assert re.search(r"speed +max +\d+\.?\d* ± \d.* mm/s +0 % ", output)


def test_a_sweep_in_which_all_fall_still_ends(tmp_path):
    """Nothing to be best is null in the summary, no figure, no crash."""
    result = run_sweep(SPEC | {"plots": True}, tmp_path, simulator=FakeSimulator(falls_above=0.0))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["status"] == {"fell": 36}
    assert summary["best"]["speed"] is None
    assert result.plots == []


def test_fixed_values_reach_the_simulator(tmp_path):
    """What `set` and the pilot name is simulated, though it is no column."""
    spec = {"set": {"contact.friction": 2.0}, "vary": {"frequency": [0.5]}}
    result = run_sweep(spec, tmp_path, simulator=FakeSimulator())
    assert result.table.column("speed").to_pylist() == pytest.approx([0.06])
    assert "contact.friction" not in result.table.column_names


def test_each_run_has_a_body_and_the_table_says_which(tmp_path):
    """The bodies' parameters reach the simulator and are columns, beside the body's number; chunks do not matter."""
    spec = {
        "vary": {"frequency": [0.5, 0.6]},
        "randomize": {"from": "identified", "repeats": 6},
        "plots": False,
    }
    whole = run_sweep(spec | {"chunk": 12}, tmp_path / "whole", simulator=FakeSimulator()).table
    parts = run_sweep(spec | {"chunk": 5}, tmp_path / "parts", simulator=FakeSimulator()).table
    assert parts.drop(["seed"]).equals(whole.drop(["seed"]))
    body, ensemble = whole.column("body").to_numpy(), identified.bodies()
    assert meta(whole.schema.field("body"))["role"] == "index"
    for name, column in ensemble.values.items():
        np.testing.assert_array_equal(whole.column(name).to_numpy(), column[body])
        assert meta(whole.schema.field(name))["role"] == "randomized"
    friction = whole.column("contact.friction").to_numpy()
    slower = (
        whole.column("speed").to_numpy()
        - 0.01 * (friction - 1.0)
        - whole.column("start.x").to_numpy()
    )
    np.testing.assert_allclose(slower, speed(whole.column("frequency").to_numpy()), atol=1e-6)


SWEEPS = [
    pytest.param(path, id=path.stem)
    for path in sorted(Path(__file__).parents[2].glob("sweeps/*.yaml"))
    if not re.search("^(tune|objective|pareto|task):", path.read_text(), re.MULTILINE)
]


@pytest.mark.release(cases=("sagittal_spine", "three_gaits"))
@pytest.mark.parametrize("path", SWEEPS)
def test_the_sweeps_of_the_repository_run(tmp_path, path):
    """Every shipped sweep file is valid, makes a table, and its repeats and sizes are as its text says.

    Nothing is recorded, which walks on an engine: see test_sweep_keep.py.
    """
    sweep = Sweep.from_file(path)
    result = run_sweep(
        dataclasses.replace(sweep, plots=False, keep=None), tmp_path, simulator=FakeSimulator()
    )
    assert result.complete
    row_count = sweep.variants * sweep.repeats
    assert np.array_equal(result.table.column("row").to_numpy()[:row_count], np.arange(row_count))
    assert (result.table.num_rows > row_count) == (sweep.optimum is not None)
    if path.stem == "quickstart":
        assert sweep.variants >= 200
        assert read_table(tmp_path).num_rows == sweep.variants


@pytest.mark.release
def test_figures_go_into_a_directory_that_is_named_from_here(tmp_path, monkeypatch):
    """As the README's command names it: `--out runs/quickstart`."""
    monkeypatch.chdir(tmp_path)
    result = run_sweep(SPEC | {"plots": True}, "runs/here", simulator=FakeSimulator())
    assert result.plots
    assert all(path.exists() and path.parent == Path("runs/here/plots") for path in result.plots)
