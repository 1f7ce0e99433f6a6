# Tests of sweep/replay.py
"""A row of a sweep run again: the same walk, bit for bit, with its recording; or a sentence that says why not."""

from __future__ import annotations

import functools
import json
import math
import os
import re
import shutil
from pathlib import Path
from typing import Any

import command
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fakes.sweep_fake import FakeSimulator, part_of, speed

from nermo_mjx.physics.c_engine import CEngine, CSession, _Block
from nermo_mjx.rollout import METRICS, Simulator
from nermo_mjx.sweep import SpecError, Sweep, read_table, run_sweep
from nermo_mjx.sweep import replay as module
from nermo_mjx.sweep.replay import agreement, find_row, replay_row
from nermo_mjx.view import Recording

pytestmark = pytest.mark.usefixtures("shared_simulators")

call, json_of = (
    functools.partial(function, "replay") for function in (command.call, command.json_of)
)
#: Eight rows in chunks of 3, 3 and 2, so that the last chunk's batch is padded. With so heavy a rear and 1.2 Hz, the
#: robot falls. Repeats start from different places.
WALKS = {
    "spine": "stride_extension",
    "run": {"cycles": 2, "warmup_cycles": 0.25},
    "chunk": 3,
    "plots": False,
    # Weak servos carry the robot, but not a heavy one, which goes to the ground where no sphere of the trunk stops it.
    "physics": "fast",
    "set": {"servo.torque_limit": 0.02},
    "vary": {"frequency": [1.0, 1.2], "mass.front": [0.1695, 0.5]},
    "randomize": {
        "repeats": 2,
        "start.x": {"uniform": [-0.1, 0.1]},
        "start.y": {"uniform": [-0.1, 0.1]},
    },
}
ROWS = 8
#: As short as a sweep can be; one chunk.
SHORT = {"run": {"duration": 0.4, "warmup": 0.1}, "plots": False, "vary": {"frequency": [0.8, 0.9]}}


@pytest.fixture(scope="module")
def walks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Made by a simulator of its own: those that replay its rows are others."""
    simulator = Simulator(Sweep.from_dict(WALKS).setup, "c")
    return run_sweep(WALKS, tmp_path_factory.mktemp("walks"), engine="c", simulator=simulator).out


@pytest.fixture(scope="module")
def short(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_sweep(SHORT, tmp_path_factory.mktemp("short"), engine="c").out


def row_of(out: Path, row: int) -> dict[str, Any]:
    (matching_row,) = (line for line in read_table(out).to_pylist() if line["row"] == row)
    return matching_row


def same(replayed: dict[str, float], stored: dict[str, Any]) -> None:
    for name in METRICS:
        np.testing.assert_array_equal(replayed[name], stored[name], err_msg=name)


def losing_its_numbers(monkeypatch: pytest.MonkeyPatch, frequency: float, after: int) -> None:
    """From now on every world that walks at this frequency loses its velocities after so many ticks."""
    begin, tick, done, walks = _Block.__init__, _Block._tick, {}, {}

    def noted(self: _Block, engine: CEngine, params: Any, *rest: Any) -> None:
        walks[id(self)], done[id(self)] = np.asarray(params.control.gait.frequency), 0
        begin(self, engine, params, *rest)

    def broken(self: _Block) -> None:
        done[id(self)] += 1
        if done[id(self)] == after + 1:
            lost = np.isclose(walks[id(self)][: self.worlds], frequency)
            self.batch.bind("qvel")[lost] = np.nan
        tick(self)

    monkeypatch.setattr(_Block, "__init__", noted)
    monkeypatch.setattr(_Block, "_tick", broken)


# --- the same walk


@pytest.mark.release
def test_every_row_of_a_sweep_is_repeated_bit_for_bit(walks: Path) -> None:
    """On the engine c, whatever part a row stands in, and where in it; fallen robots, too."""
    statuses, parts = set(), set()
    for row in (0, 3, 5, 7):
        parts.add(part_of(walks, row))
        stored, replay = row_of(walks, row), replay_row(find_row(walks, row))
        same(replay.metrics, stored)
        assert replay.status == stored["status"]
        assert replay.comparison is not None
        assert replay.comparison.equal
        statuses.add(replay.status)
    assert statuses == {"ok", "fell"}
    assert len(parts) == 3


@pytest.mark.release
def test_the_recording_is_of_the_walk_that_the_table_measured(walks: Path, tmp_path: Path) -> None:
    """It starts where the row starts, ends with the run, and between its times lies the table's distance."""
    for row in (0, 1):
        stored = row_of(walks, row)
        json_of(walks, "--row", str(row), "--record", tmp_path / "row.npz")
        recording = Recording.load(tmp_path / "row.npz")
        begin, end = 0.25 / stored["frequency"], 2 / stored["frequency"]
        assert recording.time[-1] == pytest.approx(end)
        x, y = (
            np.interp([begin, end], recording.time, recording.sensors["position"][:, i])
            for i in (0, 1)
        )
        assert y[0] - y[1] == pytest.approx(stored["distance"], abs=2e-6), "float32 in the metrics"
        assert x[1] - x[0] == pytest.approx(stored["lateral_drift"], abs=2e-6)
        assert recording.qpos[0, :2] == pytest.approx(
            [stored["start.x"], stored["start.y"]], abs=2e-3
        )
        assert recording.metadata["parameters"]["start.yaw"] == stored["start.yaw"]
        assert recording.metadata["metrics"]["distance"] == stored["distance"]


@pytest.mark.release
def test_a_run_that_ends_at_a_distance_is_repeated_and_its_recording_ends_there(
    tmp_path: Path,
) -> None:
    """Ten simulated seconds are allowed; the distance takes less than three."""
    spec = {
        "pilot": {"straight": {"distance": 0.08}},
        "run": {"duration": 10.0, "warmup": 0.2},
        "plots": False,
        "set": {"frequency": 1.0},
        "vary": {"contact.friction": [0.8, 1.4]},
    }
    out = run_sweep(spec, tmp_path, engine="c").out
    for row in (0, 1):
        stored, replay = row_of(out, row), replay_row(find_row(out, row))
        same(replay.metrics, stored)
        ends = 0.2 + stored["duration"]
        assert ends <= replay.history.time[-1] <= ends + 0.26, "a block of ticks later at most"
        assert ends < 3.0


@pytest.mark.release
def test_a_row_that_the_sweep_has_not_come_to_is_replayed_as_it_will_be(
    walks: Path, tmp_path: Path
) -> None:
    """Its chunk is missing: nothing to compare with; when the sweep goes on, the table gets the same numbers."""
    out = tmp_path / "part"
    shutil.copytree(walks, out)
    part_of(out, 1).unlink()
    missing = set(range(ROWS)) - set(read_table(out).column("row").to_pylist())
    assert len(missing) == 3
    row = max(missing)
    report = json_of(out, "--row", str(row))
    assert report["comparison"] is None
    assert report["compared"] == "Not compared: the sweep has not run this row yet."
    assert report["engine"] == "c", "as the other chunks"
    replay = replay_row(find_row(out, row))
    run_sweep(out / "sweep.yaml", out)
    same(replay.metrics, row_of(out, row))
    assert json_of(out, "--row", str(row))["comparison"]["equal"] is True


@pytest.mark.release
def test_the_directory_is_only_read(short: Path) -> None:
    def content() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in (short, *short.rglob("*"))}

    before = content()
    assert call(short, "--row", "1").exit_code == 0
    assert content() == before


# --- comparing


def test_the_largest_relative_difference_is_named() -> None:
    stored = {"speed": 0.1, "slip": 2.0, "cost_of_transport": math.nan, "fell": 0.0}
    assert agreement(stored, dict(stored), "c").equal
    assert not agreement(stored, stored | {"speed": float(np.nextafter(0.1, 1.0))}, "c").equal
    differs = agreement(stored, stored | {"speed": 0.11, "slip": 1.0}, "c")
    assert (differs.equal, differs.metric, differs.stored, differs.replayed) == (
        False,
        "slip",
        2.0,
        1.0,
    )
    assert differs.relative_difference == pytest.approx(0.5)
    unknown = agreement(stored, stored | {"cost_of_transport": 3.0, "slip": 1.0}, "c")
    assert (unknown.metric, unknown.relative_difference) == ("cost_of_transport", math.inf)


@pytest.mark.release
def test_a_row_of_another_engine_is_compared_and_runs_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A table in closed form, as if of mjx: its speed is far from the robot's, which the report says."""
    run_sweep(SHORT, tmp_path, simulator=FakeSimulator(engine="mjx"))
    worlds = []
    opened = CSession.__init__
    monkeypatch.setattr(
        CSession, "__init__", lambda self, *a: (worlds.append(len(a[2])), opened(self, *a))[1]
    )
    report = json_of(tmp_path, "--row", "0", "--engine", "c")
    assert worlds == [1]
    difference = report["comparison"]
    assert (report["engine"], difference["engine"], difference["equal"]) == ("c", "mjx", False)
    expected = {"speed": float(np.float32(speed(0.8))), "roll_std": 0.1}
    shares = {
        n: abs(report["metrics"][n] - x) / max(abs(report["metrics"][n]), x)
        for n, x in expected.items()
    }
    worst = max(shares, key=shares.__getitem__)
    assert difference["metric"] == worst
    assert difference["relative_difference"] == pytest.approx(shares[worst])
    assert f"(engine mjx), most of all {worst}: " in report["compared"]


@pytest.mark.parametrize(
    ("begun", "taken"), [("mjx", "mjx"), ("c", "c"), ("fake", "auto"), (None, "auto")]
)
def test_the_engine_is_that_of_the_sweep(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, begun: str | None, taken: str
) -> None:
    """Or `auto`, where the sweep has not begun, or was made by something else; `--engine` says otherwise."""
    run_sweep(SHORT, tmp_path, simulator=FakeSimulator(engine=begun))
    if begun is None:
        shutil.rmtree(tmp_path / "results")
    engines = []

    def simulator(setup: object, engine: str) -> None:
        engines.append(engine)
        raise SpecError("no further")

    monkeypatch.setattr(module, "Simulator", simulator)
    for engine in (None, "c"):
        with pytest.raises(SpecError, match="no further"):
            replay_row(find_row(tmp_path, 1), engine)
    assert engines == [taken, "c"]


def test_rows_of_a_changed_sweep_are_not_compared(short: Path, tmp_path: Path) -> None:
    """Whoever edits sweep.yaml in the directory is told that the table is another sweep's."""
    out = tmp_path / "edited"
    shutil.copytree(short, out)
    text = (out / "sweep.yaml").read_text()
    assert "0.9" in text
    (out / "sweep.yaml").write_text(text.replace("0.9", "0.7"))
    report = json_of(out, "--row", "0", "--engine", "c")
    assert report["comparison"] is None
    assert "made by another sweep.yaml, or with other defaults" in report["compared"]


# --- falls and divergence


@pytest.mark.release
def test_a_fall_is_dated(walks: Path) -> None:
    """The table stops measuring when the robot falls: warm-up and measured time add up to the time of the fall."""
    row = next(line["row"] for line in read_table(walks).to_pylist() if line["status"] == "fell")
    stored = row_of(walks, row)
    assert stored["duration"] > 0.0
    fell_at = json_of(walks, "--row", str(row))["metrics"]["failure_time"]
    assert fell_at == pytest.approx(0.25 / stored["frequency"] + stored["duration"], abs=0.0101)
    assert (
        f"It fell at {fell_at:.2f} s, of {2 / stored['frequency']:.2f} s."
        in call(walks, "--row", str(row)).stdout
    )


def test_a_diverged_world_is_recorded_until_its_first_bad_sample(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It loses its numbers in the tick that ends at 0.24 s; 23 samples before it are good."""
    losing_its_numbers(monkeypatch, frequency=0.9, after=23)
    out = run_sweep(SHORT | {"chunk": 2}, tmp_path / "out", engine="c").out
    rows = read_table(out).to_pylist()
    assert sorted(line["status"] for line in rows) == ["diverged", "ok"]
    row = next(line["row"] for line in rows if line["status"] == "diverged")
    report = json_of(out, "--row", str(row), "--record", tmp_path / "row.npz")
    assert report["metrics"]["failure_time"] == pytest.approx(0.24)
    assert report["comparison"]["equal"] is True
    with np.load(tmp_path / "row.npz") as file:
        assert len(file["time"]) == 23
        assert all(np.isfinite(file[name]).all() for name in file.files if name != "header")
    assert "It lost its numbers at 0.24 s, of 0.40 s." in call(out, "--row", str(row)).stdout


def test_a_world_that_diverges_at_once_gives_a_sentence(
    short: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """There is no sample to keep, so no file appears; without one to write, the summary says when."""
    losing_its_numbers(monkeypatch, frequency=0.8, after=0)
    row = 0
    result = call(short, "--row", str(row), "--record", tmp_path / "row.npz", "--quiet")
    assert result.exit_code == 1
    sentence = f"row {row} diverged in its first tick: there is nothing to record or to show."
    assert result.stderr == f"nermo-mjx: {sentence}\n"
    assert list(tmp_path.iterdir()) == []
    assert "It lost its numbers at 0.01 s, of 0.40 s." in call(short, "--row", str(row)).stdout


# --- wrong use


@pytest.mark.parametrize(
    ("file", "text", "row", "sentence"),
    [
        ("out/sweep.yaml", json.dumps(SHORT), "2", "row is 2: allowed is 0 to 1."),
        ("out/sweep.yaml", json.dumps(SHORT), "-1", "row is -1: allowed is 0 to 1."),
        ("out/sweep.yaml", "vary: {frequency: [0.8", "0", "out/sweep.yaml:1: not valid YAML"),
        ("other", "", "0", "out: no such directory."),
        ("out", "", "0", "out: this is a file, not a directory."),
        (
            "out/other",
            "",
            "0",
            "out: not the directory of a sweep or a search; allowed is one with",
        ),
    ],
)
def test_wrong_use_is_refused_before_a_simulator_is_built(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, file: str, text: str, row: str, sentence: str
) -> None:
    (tmp_path / file).parent.mkdir(exist_ok=True)
    (tmp_path / file).write_text(text)
    monkeypatch.setattr(module, "Simulator", None)
    result = call(tmp_path / "out", "--row", row)
    assert result.exit_code == 2
    assert result.stdout == ""
    assert sentence in " ".join(result.stderr.split())


@pytest.mark.parametrize(
    ("options", "sentence"),
    [
        (("--video", "row.avi"), "a video ends in .mp4, .gif or .webp"),
        (
            ("--video", "row.gif", "--camera", "moon"),
            "camera is 'moon': allowed is one of three_quarter",
        ),
        (("--record", "/sys/kernel/nermo/row.npz"), "cannot write in /sys/kernel/nermo: "),
    ],
)
def test_files_that_cannot_be_made_are_refused_before_a_simulator_is_built(
    short: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    options: tuple[str, ...],
    sentence: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(module, "Simulator", None)
    result = call(short, "--row", "0", *options)
    assert result.exit_code == 2
    assert sentence in result.stderr


# --- what is shown


def test_the_summary_is_that_of_a_walk_with_the_row_and_the_comparison(short: Path) -> None:
    text = call(short, "--row", "1").stdout
    assert text.startswith(f"Row 1 of {short}: variant 1, repeat 0, frequency 0.9\n")
    assert re.search(rf"^speed +{1e3 * row_of(short, 1)['speed']:.1f} +mm/s$", text, re.MULTILINE)
    assert "speed in theory" in text
    assert text.endswith("All metrics equal the table's (engine c), to the last bit.\n")


def test_quiet_says_nothing_and_json_has_the_fields_of_a_walk(short: Path) -> None:
    result = call(short, "--row", "0", "--quiet")
    assert (result.exit_code, result.stdout, result.stderr) == (0, "", "")
    report, stored = json_of(short, "--row", "0"), row_of(short, 0)
    assert {"metrics", "parameters", "setup", "run", "engine", "versions"} <= set(report)
    assert (report["row"], report["variant"], report["repeat"], report["seed"]) == (
        0,
        0,
        0,
        stored["seed"],
    )
    assert report["metrics"]["distance"] == stored["distance"]
    assert report["parameters"]["frequency"] == 0.8
    assert report["parameters"]["stride"] > 0, "defaults are in it too"
    assert report["metrics"]["fell"] is False
    assert report["metrics"]["failure_time"] is None


@pytest.mark.release
@pytest.mark.usefixtures("drawing")
def test_a_row_can_be_watched(short: Path, tmp_path: Path) -> None:
    video = tmp_path / "row.gif"
    result = call(short, "--row", "0", "--video", video, "--camera", "side")
    assert result.exit_code == 0, result.stderr
    assert result.stdout.endswith(f"wrote {video}\n")
    assert os.path.getsize(video) > 1000


def test_one_last_digit_is_a_difference(short: Path, tmp_path: Path) -> None:
    """A table in which one number is another by its last bit is not equal any more."""
    out = tmp_path / "changed"
    shutil.copytree(short, out)
    (path,) = (out / "results").iterdir()
    table = pq.read_table(path)
    column_index, values = table.column_names.index("roll_std"), table.column("roll_std").to_numpy()
    changed = table.set_column(
        column_index, table.schema.field("roll_std"), pa.array(np.nextafter(values, 1.0))
    )
    pq.write_table(changed.replace_schema_metadata(table.schema.metadata), path)
    difference = json_of(out, "--row", "0")["comparison"]
    assert (difference["equal"], difference["metric"]) == (False, "roll_std")
    assert difference["replayed"] == row_of(short, 0)["roll_std"]
    assert 0.0 < difference["relative_difference"] < 1e-15
