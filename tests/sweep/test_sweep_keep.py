# Tests of sweep/store.py, rollout/saving.py
"""Outputs of a sweep besides its table: time series of selected signals, and recordings of selected rows."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from conftest import shared_simulator
from fakes.sweep_fake import SPEC, FakeSimulator, part_of

from nermo_mjx import Recording, Run, Setup, load_robot
from nermo_mjx.rollout import METRICS, Saving, Series
from nermo_mjx.rollout.saving import all_signals, chosen_signals
from nermo_mjx.runs import Interrupted, Watch
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep import SpecError, Sweep, read_table, run_sweep, store
from nermo_mjx.sweep.replay import kept_rows, replay_row
from nermo_mjx.sweep.spec import Keep
from nermo_mjx.sweep.table import Results, meta, sweep_status

pytestmark = pytest.mark.usefixtures("shared_simulators")
SAVED: dict[str, Any] = {**SPEC, "save": {"sensors": ["gyro", "speed"], "rate": 20}}


class Saver(FakeSimulator):
    """Keeps the fake's speed and time; a run lasts as many samples as its frequency has tenths."""

    def run(self, values: Any, run: Run, *, save: Saving | None = None, **how: Any) -> Any:
        result = super().run(values, run, **how)
        count = np.round(10 * values["frequency"]).astype(int)
        time = (1 + np.arange(count.max())) / 20
        series = {
            name: np.tile(time, (len(count), 1)).astype(np.float32)
            for name in ("gyro_x", "gyro_y", "gyro_z")
        }
        assert save == Saving(("gyro", "speed"), 20.0)
        speed = np.repeat(result.metrics["speed"][:, None], len(time), axis=1)
        result.series = Series(time, series | {"speed": speed}, count)
        return result


def samples(out: Path) -> pa.Table:
    """All time series of a directory, in order."""
    tables = [pq.read_table(path) for path in (out / "series").glob("*.parquet")]
    return pa.concat_tables(tables).sort_by([("row", "ascending"), ("time", "ascending")])


# --- time series


def test_series_stand_beside_the_table_a_row_a_sample(tmp_path: Path) -> None:
    """Rows of the table and samples of the series tell the same; a chunk's last batch is filled up, which is left."""
    run_sweep(SAVED, tmp_path, chunk=5, simulator=Saver())
    frame, table = (
        pandas.read_parquet(tmp_path / "series"),
        read_table(tmp_path).to_pandas().set_index("row"),
    )
    assert [*frame.columns] == ["row", "time", "gyro_x", "gyro_y", "gyro_z", "speed"]
    samples = frame.groupby("row")
    assert samples.size().to_dict() == np.round(10 * table["frequency"]).astype(int).to_dict()
    np.testing.assert_array_equal(samples.speed.max(), table["speed"].astype(np.float32))
    np.testing.assert_allclose(frame.time, frame.gyro_z, rtol=1e-6)
    assert (samples.time.diff().dropna() > 0).all()
    field = pq.read_schema(next(tmp_path.glob("series/*"))).field("gyro_x")
    assert (field.type, meta(field)["unit"], meta(field)["role"]) == (
        pa.float32(),
        "rad/s",
        "signal",
    )


def test_a_stopped_sweep_goes_on_to_the_same_series(tmp_path: Path) -> None:
    run_sweep(SAVED, tmp_path / "whole", chunk=5, simulator=Saver())
    with pytest.raises(Interrupted):
        run_sweep(SAVED, tmp_path / "part", chunk=5, simulator=Saver(stop_at=3))
    assert len(list(tmp_path.glob("part/series/*"))) == 3
    for shard in ((0, 2), (1, 2)):
        run_sweep(SAVED, tmp_path / "part", chunk=5, shard=shard, simulator=Saver())
    assert samples(tmp_path / "part").equals(samples(tmp_path / "whole"))


def test_series_come_along_when_a_sweep_is_extended_or_used(tmp_path: Path) -> None:
    """With their runs' new numbers; of the larger sweep's own directory they are not there twice."""
    small = SAVED | {"vary": SAVED["vary"] | {"frequency": [0.7, 1.1]}}
    run_sweep(SAVED, tmp_path / "whole", chunk=5, simulator=Saver())
    run_sweep(small, tmp_path / "small", chunk=5, simulator=Saver())
    run_sweep(
        SAVED, tmp_path / "used", chunk=5, simulator=(used := Saver()), use=[tmp_path / "small"]
    )
    run_sweep(SAVED, tmp_path / "small", simulator=(extended := Saver()), extend=True)
    for simulator, out in ((used, "used"), (extended, "small")):
        assert sum(simulator.batches) < 36
        assert samples(tmp_path / out).equals(samples(tmp_path / "whole"))
        assert read_table(tmp_path / out).equals(read_table(tmp_path / "whole"))


def test_what_is_saved_belongs_to_the_sweep(tmp_path: Path) -> None:
    """Of another rate or without series, the directory is another sweep's; a file without `save` is what it was."""
    run_sweep(SAVED, tmp_path, chunk=5, simulator=Saver())
    with pytest.raises(DirectoryError, match=r"save.rate is 20 there and 50 here"):
        run_sweep({**SPEC, "save": {"sensors": ["gyro", "speed"]}}, tmp_path, simulator=Saver())
    with pytest.raises(DirectoryError, match=r"save.rate is 20 there and absent here"):
        run_sweep(SPEC, tmp_path, simulator=FakeSimulator())
    assert Sweep.from_file(tmp_path / "sweep.yaml").save == Saving(("gyro", "speed"), 20.0)
    assert not {"save", "keep"} & Sweep.from_dict(SPEC).resolved().keys()


@pytest.mark.parametrize(
    ("save", "message"),
    [
        (
            {"sensors": ["gyr"]},
            r"save.sensors' has 'gyr': allowed are qpos, qvel, servo_command, .*; did you mean 'gyro'\?",
        ),
        ({"sensors": ["front_left_foot_forc"]}, r"did you mean 'front_left_foot_force'\?"),
        ({"sensors": []}, "save.sensors' is an empty list: name sensors"),
        ({"rate": 50}, "save' has no 'sensors': expected {sensors:"),
        (
            {"sensors": "gyro", "rate": 30},
            "save.rate' is 30: allowed is the control rate, 100 Hz, or that divided by a "
            "whole number; the nearest is 33.3333",
        ),
        ({"sensors": "gyro", "rate": 500}, "save.rate' is 500: .* the nearest is 100"),
        ({"sensors": "gyro", "rate": 0}, "save.rate' is 0: expected a finite number above 0"),
        (
            {"sensors": "gyro", "rat": 50},
            r"save.rat' is not a field of what is saved; .*did you mean 'rate'\?",
        ),
    ],
)
def test_what_cannot_be_saved_is_refused(save: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        Sweep.from_dict({**SPEC, "save": save})


def test_series_that_do_not_fit_are_refused_or_make_smaller_chunks(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A run of 8 s has 160 samples of 16 + 4 x 4 bytes."""
    sweep, seconds = Sweep.from_dict(SAVED), np.array([4.0, 8.0, 8.0, 2.0])
    assert store.series_bytes(sweep, seconds) == 22 * 20 * 32
    monkeypatch.setattr(store, "LARGEST_CHUNK", 3 * 160 * 32)
    monkeypatch.setattr(store, "simulated_seconds", lambda *_: seconds)
    monkeypatch.setattr(store, "chunk_rows_here", lambda *_: 64)
    rows = store.SweepRows(sweep)
    assert rows.chunk(None, "c", 1, simulate=False) == 3
    assert rows.chunk(2, "c", 1, simulate=False) == 2
    with pytest.raises(
        SpecError, match=r"save takes 14.1 kB of memory for a chunk of 4 runs: .* take chunk: 3"
    ):
        rows.chunk(4, "c", 1, simulate=False)


def test_a_full_disk_is_seen_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        store.shutil, "disk_usage", lambda _: shutil._ntuple_diskusage(10**9, 10**9, 1000)
    )
    with pytest.raises(DirectoryError, match="room for 1 kB, and the time series would take up to"):
        run_sweep(SAVED, tmp_path, chunk=5, simulator=Saver())
    assert not list((tmp_path / "results").iterdir())


@pytest.mark.release
def test_what_a_simulator_saves_is_its_recording_at_a_rate() -> None:
    """Worlds of two lengths, one a quarter of the control rate, blocks that begin between two samples."""
    saving = Saving(
        ("front_left_foot_velocity", "spine_ctrl", "qvel_root_z", "yaw", "speed"), 100 / 3
    )
    simulator = shared_simulator(Setup(), "c")
    result = simulator.run(
        {"frequency": [1.0, 2.0]}, Run(cycles=0.6, warmup_cycles=0), record=True, save=saving
    )
    series, trace = result.series, result.trace
    assert series is not None
    assert trace is not None
    np.testing.assert_allclose(series.time, 0.03 * np.arange(1, 21), atol=1e-9)
    assert series.count.tolist() == [20, 10], "0.6 and 0.3 s"
    sample_index = np.searchsorted(trace.time, series.time - 1e-6)
    velocity, foot = (
        trace.sensors["linear_velocity"][:, sample_index],
        trace.sensors["foot_velocity"][:, sample_index, 0],
    )
    expected = {
        "front_left_foot_velocity_x": foot[..., 0],
        "front_left_foot_velocity_y": foot[..., 1],
        "front_left_foot_velocity_z": foot[..., 2],
        "spine_servo_command": trace.ctrl[:, sample_index, 8],
        "qvel_root_z": trace.qvel[:, sample_index, 2],
        "speed": np.linalg.norm(velocity[..., :2], axis=-1),
    }
    assert set(series.values) == {*expected, "yaw"}
    for name, values in expected.items():
        np.testing.assert_allclose(series.values[name], values, atol=1e-6, err_msg=name)
    w, x, y, z = np.moveaxis(trace.sensors["orientation"][:, sample_index], -1, 0)
    np.testing.assert_allclose(
        series.values["yaw"], np.arctan2(2 * (w * z - x * y), 1 - 2 * (x * x + z * z)), atol=1e-6
    )


def test_signals_have_the_names_of_the_models_sensors() -> None:
    """And each number of the state has a signal, by the names of MuJoCo's joints."""
    robot = load_robot()
    model, every = robot.physical, all_signals(robot)
    signal_names = {name for signal in every for name in signal.names}
    # Velocities of the compliant joints are those of the state.
    joints = {
        f"{name.removeprefix('qvel_')}_velocity"
        for name in signal_names
        if name.startswith("qvel_")
    }
    assert {model.sensor(i).name for i in range(model.nsensor)} - signal_names - joints == {
        "tail_tip_force"
    }
    assert sum(signal.source == "qpos" for signal in every) == model.nq
    assert sum(signal.source == "qvel" for signal in every) == model.nv
    (hip,) = chosen_signals(robot, Saving(("qpos_rear_left_hip",)))
    assert hip.place == model.joint("rear_left_hip").qposadr[0]
    assert len({signal.name for signal in every}) == len(every)


# --- kept rows


def results(speed: list[float], status: list[str], variant: list[int]) -> Results:
    fields = [
        pa.field("speed", pa.float64(), metadata={"role": "metric", "better": "high"}),
        pa.field("own", pa.float64(), metadata={"role": "metric", "better": "low"}),
    ]
    table = pa.table(
        {
            "row": range(len(speed)),
            "variant": variant,
            "status": status,
            "speed": speed,
            "own": speed,
        }
    )
    for field in fields:
        table = table.set_column(
            table.column_names.index(field.name), field, table.column(field.name)
        )
    return Results(table)


def test_the_best_of_each_variant_and_the_first_that_fell_are_kept() -> None:
    table = results(
        speed=[0.3, 0.9, 0.5, 0.6, 9.0, np.nan, 0.4],
        variant=[0, 0, 1, 1, 2, 2, 3],
        status=["ok", "ok", "ok", "ok", "fell", "diverged", "fell"],
    )
    assert kept_rows(table, Keep(best=2)) == {1: "number 1 by speed", 3: "number 2 by speed"}
    assert [*kept_rows(table, Keep(best=9, metric="own"))] == [0, 2]
    assert kept_rows(table, Keep(fell=1, diverged=4, unsolved=2)) == {4: "fell", 5: "diverged"}
    assert kept_rows(table, Keep()) == {}


def test_the_best_are_variants_not_their_luckiest_runs() -> None:
    """By their means, each as its typical run; one with lost runs, or without a number in one, after all others."""
    table = results(
        speed=[0.1, 0.1, 0.9, 0.5, 0.6, 0.7, 2.0, 2.0, 2.0, 3.0, 3.0, np.nan, 0.2, 0.2, 0.2],
        variant=[0, 0, 0, 1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 4],
        status=["ok"] * 8 + ["fell"] + ["ok"] * 6,
    )
    assert kept_rows(table, Keep(best=1)) == {4: "number 1 by speed"}
    reasons = sorted(kept_rows(table, Keep(best=9)).items(), key=lambda item: item[1])
    assert [row for row, _ in reasons] == [4, 0, 12, 9, 6]


def test_every_metric_with_a_better_direction_can_choose_what_is_kept() -> None:
    """The highest, the lowest, or the nearest to zero; also of a table whose columns do not name the direction."""
    directed = [name for name, declaration in METRICS.items() if declaration.better]
    assert {"battery_time", "penetration", "lateral_drift"} < {*directed}
    for name in directed:
        assert Sweep.from_dict({**SPEC, "keep": {"best": 1, "metric": name}}).keep == Keep(
            best=1, metric=name
        )
    values = pa.array([0.3, -0.2, 0.1, -0.4])
    columns = dict.fromkeys(("battery_time", "penetration", "lateral_drift"), values)
    fields = [pa.field(name, pa.float64(), metadata={"role": "metric"}) for name in columns]
    rows = {
        "row": pa.array(range(4)),
        "variant": pa.array(range(4)),
        "status": pa.array(["ok"] * 4),
    }
    table = Results(
        pa.table(
            {**rows, **columns},
            schema=pa.schema([*(pa.field(n, c.type) for n, c in rows.items()), *fields]),
        )
    )
    rows_by_metric = {name: [*kept_rows(table, Keep(best=1, metric=name))] for name in columns}
    assert rows_by_metric == {"battery_time": [0], "penetration": [3], "lateral_drift": [2]}


KEPT: dict[str, Any] = {
    "run": {"duration": 0.4, "warmup": 0.1},
    "plots": False,
    "keep": {"best": 1},
    "vary": {"frequency": [0.7, 0.8, 0.9]},
}


def test_kept_rows_are_recorded_once_and_again_if_they_are_lost(tmp_path: Path) -> None:
    """When the table is complete, by whichever command asks; `keep` may be another one then."""
    messages: list[str] = []
    result = run_sweep(KEPT, tmp_path, engine="c", watch=Watch(warn=messages.append))
    best = int(np.argmax(read_table(tmp_path).column("speed").to_numpy()))
    (file,) = result.recordings
    assert (messages, file) == ([], tmp_path / "recordings" / f"row-{best:06d}.npz")
    recording = Recording.load(file)
    assert recording.time[-1] == pytest.approx(0.4)
    assert (
        recording.metadata["metrics"]["speed"] == read_table(tmp_path).column("speed")[best].as_py()
    )
    assert (recording.metadata["row"], recording.metadata["kept"]) == (best, "number 1 by speed")
    first = file.read_bytes(), file.stat().st_mtime_ns
    again = run_sweep({**KEPT, "keep": {"best": 2, "metric": "slip"}}, tmp_path, engine="c")
    assert (file.read_bytes(), file.stat().st_mtime_ns) == first
    assert len(again.recordings) == 2
    file.write_bytes(b"damaged")
    run_sweep(KEPT, tmp_path, engine="c")
    np.testing.assert_array_equal(Recording.load(file).qpos, recording.qpos)
    assert file.with_name(f"{file.name}.aside-1").read_bytes() == b"damaged"


def test_a_stopped_sweep_records_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec, done = {**KEPT, "keep": {"best": 3}}, []

    def stopped(sweep_row: Any, *args: Any, **how: Any) -> Any:
        if len(done) == 1:
            raise KeyboardInterrupt
        done.append(sweep_row.row)
        return replay_row(sweep_row, *args, **how)

    with monkeypatch.context() as patch:
        patch.setattr("nermo_mjx.sweep.replay.replay_row", stopped)
        with pytest.raises(Interrupted, match="run the same command again"):
            run_sweep(spec, tmp_path, engine="c")
    (file,) = (tmp_path / "recordings").iterdir()
    first = file.stat().st_mtime_ns
    assert sweep_status(tmp_path).notes == ("1 of its runs is recorded in recordings/.",)
    assert len(run_sweep(spec, tmp_path, engine="c").recordings) == 3
    assert (file.stat().st_mtime_ns, len(list((tmp_path / "recordings").iterdir()))) == (first, 3)


def test_a_replay_that_gives_other_numbers_says_so(tmp_path: Path) -> None:
    """A table in closed form is not what the robot does."""
    messages: list[str] = []
    run_sweep(
        KEPT, tmp_path, simulator=FakeSimulator(engine="c"), watch=Watch(warn=messages.append)
    )
    (sentence,) = messages
    assert sentence.startswith(
        "row 2 as it is recorded: The metrics differ from the table's (engine c), most of all "
    )
    assert (
        Recording.load(tmp_path / "recordings" / "row-000002.npz").metadata["compared"] in sentence
    )


@pytest.mark.parametrize(
    ("keep", "message"),
    [
        (
            {"best": 2, "metric": "sped"},
            r"keep.metric' is 'sped': allowed is a metric with a better direction, "
            r"speed, .*; did you mean 'speed'\?",
        ),
        ({"best": 2, "metric": "yaw_mean"}, "allowed is a metric with a better direction"),
        ({"best": -1}, "keep.best' is -1: expected a whole number from 0"),
        ({"falls": 1}, r"keep.falls' is not a field of what is kept; .*did you mean 'fell'\?"),
        (3, "keep' is the number 3: expected {best: 3, fell: 3, diverged: 3}"),
    ],
)
def test_what_cannot_be_kept_is_refused(keep: Any, message: str) -> None:
    with pytest.raises(SpecError, match=message):
        Sweep.from_dict({**SPEC, "keep": keep})


def test_what_is_kept_does_not_change_the_sweep() -> None:
    """So that a complete sweep can be asked for more of it."""
    assert Sweep.from_dict({**SPEC, "keep": {"fell": 3}}).digest() == Sweep.from_dict(SPEC).digest()
    assert Sweep.from_text(Sweep.from_dict({**SPEC, "keep": {"fell": 3}}).to_yaml()).keep == Keep(
        fell=3
    )


@pytest.mark.extra
@pytest.mark.parametrize("package", ["pandas", "polars", "duckdb"])
def test_series_open_in_the_lines_of_the_page(tmp_path: Path, package: str) -> None:
    """As docs/files.md has them, but for runs that are shorter; one run, and runs beside their parameters, too."""
    module = pytest.importorskip(package)
    run_sweep(SAVED, tmp_path, chunk=5, simulator=Saver())
    section = (
        (Path(__file__).parents[2] / "docs" / "files.md").read_text().partition("## Time series")[2]
    )
    lines = [
        line.replace("DIR", str(tmp_path)) for line in section.partition("\n## ")[0].splitlines()
    ]
    (line,) = (line for line in lines if line.startswith(f"{package}."))
    answer = eval(line.replace("time > 1", "time > 0.3"), {package: module})
    table = read_table(tmp_path)
    samples = np.round(10 * table.column("frequency").to_numpy()).astype(int)
    if package == "duckdb":
        expected = {row: n / 20 for row, n in enumerate(samples.tolist()) if n > 6}
        assert dict(answer.fetchall()) == pytest.approx(expected)
        return
    assert len(answer) == samples.sum()
    if package == "pandas":
        scope: dict[str, Any] = {"pandas": module}
        exec("\n".join(line for line in lines if line.startswith(("one = ", "both = "))), scope)
        assert len(scope["one"]) == samples[1]
        assert (scope["both"]["speed_x"] == scope["both"]["speed_y"].astype(np.float32)).all()


@pytest.mark.parametrize("damage", ["missing", "flipped"])
def test_runs_without_their_series_are_made_again(tmp_path: Path, damage: str) -> None:
    run_sweep(SAVED, tmp_path, chunk=5, simulator=Saver())
    before, part = samples(tmp_path), part_of(tmp_path, 12)
    file = tmp_path / "series" / pq.read_metadata(part).metadata[b"series"].decode()
    if damage == "missing":
        file.unlink()
    else:
        file.write_bytes(file.read_bytes().replace(b"gyro_x", b"gyro_y", 1))
    damaged, messages = file.read_bytes() if file.exists() else b"", []
    result = run_sweep(SAVED, tmp_path, simulator=Saver(), watch=Watch(warn=messages.append))
    assert result.chunks_run == 1
    assert len(messages) == 1
    assert f"{part} has no time series, or damaged ones; it is kept in results.aside" in messages[0]
    assert samples(tmp_path).equals(before)
    assert [path.read_bytes() for path in tmp_path.glob("series.aside/*")] == [damaged] * (
        damage == "flipped"
    )
