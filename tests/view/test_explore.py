# Tests of view/explore.py, view/page.py
"""The page of a directory, without a browser: its columns, its commands, what is left out, and the command."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest
from command import call
from fakes.experiment_fake import pretend
from fakes.explore_data import MEASURES, atlas, falling, many, sweep
from fakes.sweep_fake import SPEC, FakeSimulator
from scipy.spatial.transform import Rotation

from nermo_mjx import Recording, Run, load_robot, show
from nermo_mjx.cli.walk import planned_walk
from nermo_mjx.cli.walk import walk_command as walk
from nermo_mjx.experiments.run import run_experiments
from nermo_mjx.runs import DirectoryError
from nermo_mjx.sweep import Sweep, run_sweep
from nermo_mjx.view.clip import COMPACT_DETAIL, FULL_DETAIL, Frames, Models, clip_of
from nermo_mjx.view.explore import (
    commands_of,
    explore,
    recordings_in,
    runs_of,
    start_of,
    with_gain,
)
from nermo_mjx.view.page import Packer
from nermo_mjx.view.recorded import motion_of


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return sweep(tmp_path_factory.mktemp("explore") / "sweep", recorded=(3, 20))


@pytest.fixture(scope="module")
def dropped() -> Recording:
    return falling()


# --- what the page reads


def test_columns_bring_their_meaning_with_them(tmp_path: Path) -> None:
    path, values = atlas(tmp_path / "atlas")
    runs = runs_of(path)
    custom_column = runs.columns["shake"]
    assert (custom_column.unit, custom_column.better, custom_column.description) == (
        "rad/s",
        "low",
        "a custom metric",
    )
    np.testing.assert_array_equal(custom_column.values, values["shake"])
    assert runs.kind == "atlas"
    assert runs.columns["price"].better == "low", "the objective is minimized"
    assert list(runs.columns) == ["frequency", "speed", "shake", "price", "cell"]
    assert start_of(runs) == {
        "x": "speed",
        "y": "shake",
        "colour": "price",
        "cells": True,
        "of": "best",
    }
    assert runs.atlas is not None
    assert runs.atlas["measures"] == list(MEASURES)


def test_a_grid_begins_with_cells_and_a_sample_with_points(swept: Path, tmp_path: Path) -> None:
    grid = {
        "x": "frequency",
        "y": "spine.amplitude",
        "colour": "speed",
        "cells": True,
        "of": "best",
    }
    assert start_of(runs_of(swept)) == grid
    start = start_of(runs_of(many(tmp_path / "many", 50)))
    assert start == {
        "x": "frequency",
        "y": "speed",
        "colour": "speed",
        "cells": False,
        "of": "best",
    }


def test_a_sweep_begins_with_the_gain_that_its_file_asks_for(swept: Path, tmp_path: Path) -> None:
    """Over the stiff spine where a grid has one, else over the base of the comparison; of repeats, their mean."""
    runs = with_gain(swept, runs_of(swept))
    start = {
        "x": "spine.amplitude",
        "y": "spine.phase",
        "colour": "speed_gain",
        "cells": True,
        "of": "mean",
    }
    assert start_of(runs) == start
    gain, amplitude, phase = (
        runs.columns[name].values for name in ("speed_gain", "spine.amplitude", "spine.phase")
    )
    ok = runs.columns["status"].values == "ok"
    np.testing.assert_allclose(
        gain, np.where(ok & (amplitude > 0), 50 * amplitude * np.cos(phase), np.nan), rtol=1e-5
    )
    spec = {
        "run": SPEC["run"],
        "plots": False,
        "vary": {
            "spine": ["stride_extension", "none"],
            "frequency": [0.5, 0.9],
            "stride": [0.8, 1.0],
        },
        "randomize": {"repeats": 2},
        "compare": {"by": "spine", "for": ["frequency"]},
    }
    run_sweep(spec, tmp_path, simulator=FakeSimulator())
    runs = with_gain(tmp_path, runs_of(tmp_path))
    assert (
        runs.columns["speed_gain"].description
        == "speed relative to the mean of none, all else equal"
    )
    is_none = runs.columns["spine"].values == "none"
    assert np.isnan(runs.columns["speed_gain"].values[is_none]).all()
    assert np.isfinite(runs.columns["speed_gain"].values[~is_none]).all()
    assert (start_of(runs)["x"], start_of(runs)["colour"]) == ("frequency", "speed_gain")


def test_the_picture_in_the_readme_is_what_its_command_gives() -> None:
    """Its runs to be played are recorded, and its page opens on the gain over amplitude and phase."""
    quick = Sweep.from_file(Path(__file__).parents[2] / "sweeps" / "quickstart.yaml")
    assert quick.keep is not None
    assert quick.keep.best == 3
    assert {"spine.amplitude", "spine.phase"} <= {axis.name for axis in quick.axes}
    assert 0.0 in next(axis for axis in quick.axes if axis.name == "spine.amplitude").listed()


def test_a_grids_values_are_steps_and_a_samples_are_not(swept: Path, tmp_path: Path) -> None:
    def steps(path: Path) -> dict[str, bool]:
        fields_text = re.search(
            r'id="header">(.*?)</script>', explore(path, recordings=0).html, re.DOTALL
        )
        assert fields_text is not None
        return {field["name"]: field["stepped"] for field in json.loads(fields_text[1])["fields"]}

    grid = steps(swept)
    assert grid["spine.phase"]
    assert not grid["speed"], "28 different ones"
    sample = steps(many(tmp_path / "many", 40))
    assert sample["gait"]
    assert not sample["frequency"], "40 of 40 rows"


def test_of_too_many_rows_the_best_and_the_recorded_stay(tmp_path: Path) -> None:
    path = many(tmp_path / "many", 3000)
    runs = runs_of(path, required_rows=[1234], limit=600)
    speed = pq.read_table(path / "results").column("speed").to_numpy()
    assert 500 <= len(runs.rows) <= 601
    assert set(np.argsort(speed)[-300:]) <= set(runs.rows)
    assert 1234 in runs.rows
    assert (np.diff(runs.rows) > 0).all()
    np.testing.assert_array_equal(runs.columns["speed"].values, speed[runs.rows])
    notes: list[str] = []
    explore(path, notify=notes.append)
    assert notes == [], "3,000 are not too many"


def test_numbers_of_any_size_keep_five_digits() -> None:
    values = np.array([1e-30, -3.14159265, 2.5e8, 0.0, np.nan, np.inf, 1 / 3])
    for exact, error in ((False, 1e-5), (True, 1e-7)):
        packer = Packer()
        packer.floats(values, exact)
        np.testing.assert_allclose(np.frombuffer(packer.content, "<f4"), values, rtol=error)


def test_ten_thousand_rows_and_names_that_break_pages_are_a_small_page(tmp_path: Path) -> None:
    page = explore(many(tmp_path / "many", 10_000))
    assert len(page.html) < 3.2e6
    assert page.rows == 10_000
    assert "</script>," not in page.html
    assert '"\\u003c/script>"' in page.html


# --- recordings


def test_bodies_and_tendons_come_back_from_their_frames(dropped: Recording) -> None:
    """Against SciPy's rotations: a chain of bodies from the root to the last, and points that ride on them."""
    model = load_robot().model
    motion = motion_of(dropped, model, 20)
    origin = motion.position[:, mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "torso")]
    frames = Frames(model, motion, origin)
    turns: list[Rotation] = []
    places: list[np.ndarray] = []
    for i, parent in enumerate(frames.parents):
        assert parent < i
        turn = Rotation.from_quat(frames.quaternion[:, i], scalar_first=True)
        if parent < 0:
            places.append(frames.position[:, i])
        else:
            places.append(places[parent] + turns[parent].apply(frames.position[:, i]))
            turn = turns[parent] * turn
        turns.append(turn)
    np.testing.assert_allclose(
        np.stack(places, axis=1) + origin[:, None], motion.position[:, frames.bodies], atol=1e-9
    )
    for tendon in motion.tendons:
        frame_ids, points = frames.fixed(tendon.path - origin[:, None])
        for k, frame in enumerate(frame_ids):
            points_in_world = (
                points[:, k] if frame < 0 else places[frame] + turns[frame].apply(points[:, k])
            )
            np.testing.assert_allclose(points_in_world + origin, tendon.path[:, k], atol=1e-9)


def test_a_compact_recording_has_a_third_of_the_samples_and_less_than_half_the_size(
    dropped: Recording,
) -> None:
    sizes, samples = [], []
    for detail in (FULL_DETAIL, COMPACT_DETAIL):
        packer = Packer()
        header = clip_of(dropped, "one", Models(Packer()), packer, detail)
        sizes.append(len(packer.text()))
        samples.append(header["time"]["shape"][0])
    assert samples == [50, 17]
    assert sizes[1] < sizes[0] / 2


def test_recordings_share_one_robot_and_damaged_ones_are_named(swept: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(swept, tmp_path / "sweep"))
    (path / "recordings" / "row-000007.npz").write_text("damaged")
    (path / "recordings" / "notes.txt").write_text("not ours")
    notes: list[str] = []
    page = explore(path, notify=notes.append)
    assert page.recordings == 2
    assert page.html.count('"eyes":') == 1
    assert len(notes) == 1
    assert "row-000007.npz is left out" in notes[0]
    messages: list[str] = []
    assert explore(path, recordings=1, notify=messages.append).recordings == 1
    assert messages[0].startswith("1 of 3 recordings")
    assert repr(explore(path, recordings=0)).endswith("36 rows, 0 recordings)")


# --- commands


def spec_of(path: Path, **changes: Any) -> Path:
    """A copy of the sweep with other lines in its resolved file."""
    text = (path / "sweep.yaml").read_text()
    unchanged_lines = [line for line in text.splitlines() if line.partition(":")[0] not in changes]
    lines = [f"{name}: {value}" for name, value in changes.items()]
    (path / "sweep.yaml").write_text("\n".join([*unchanged_lines, *lines, ""]))
    return path


def test_the_walk_command_does_what_the_row_did(swept: Path, tmp_path: Path) -> None:
    path = spec_of(
        Path(shutil.copytree(swept, tmp_path / "sweep")),
        gait="lateral_walk",
        pilot="{arc: {radius: 0.5, direction: right}}",
        set="{duty: 0.7}",
        run="{duration: 4.0, warmup: 1.5}",
        steering="mix",
        physics="fast",
        timestep=0.01 / 3,
    )
    runs = runs_of(path)
    command = commands_of(path, runs)["walk"]
    row_index = 17
    words = shlex.split(command["words"])
    for name in command["set"]:
        words += ["--set", f"{name}={runs.columns[name].values[row_index]}"]
    context = walk.make_context("walk", words[2:])
    display_options = ("engine", "record", "video", "camera", "as_json", "quiet")
    expected_walk = planned_walk(
        **{name: value for name, value in context.params.items() if name not in display_options}
    )
    assert expected_walk.run == Run(duration=4.0, warmup=1.5)
    setup = expected_walk.setup
    assert (setup.gait, setup.spine, setup.steering) == ("lateral_walk", "stride_extension", "mix")
    assert (setup.pilot, setup.physics) == ("arc", "fast")
    assert expected_walk.values == {
        "duty": 0.7,
        "pilot.radius": 0.5,
        "pilot.direction": -1.0,
        **{
            name: runs.columns[name].values[row_index]
            for name in ("frequency", "spine.amplitude", "spine.phase")
        },
    }


@pytest.mark.parametrize(
    "changes",
    [
        {"routing": "type1"},
        {"timestep": 0.001},
        {"pilot": "{straight: {distance: 1.0}}"},
        {"controller": "a.py:B"},
    ],
)
def test_what_walk_cannot_do_gets_no_walk_command(
    swept: Path, tmp_path: Path, changes: dict[str, Any]
) -> None:
    path = spec_of(Path(shutil.copytree(swept, tmp_path / "sweep")), **changes)
    commands = commands_of(path, runs_of(path))
    assert commands["walk"] is None
    assert commands["replay"] == f"nermo-mjx replay {path} --row"


def test_the_page_names_the_profile_of_all_rows(swept: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(swept, tmp_path / "sweep"))
    assert commands_of(path, runs_of(path))["profile"] == "exact"
    assert commands_of(spec_of(path, profile="as_built"), runs_of(path))["profile"] == "as_built"


def test_structures_of_a_row_are_options_of_its_command(tmp_path: Path) -> None:
    path = many(tmp_path / "many sweeps", 20)
    (path / "sweep.yaml").write_text("spine: stride_extension\ngait: trot\n")
    commands = commands_of(path, runs_of(path))
    assert commands["walk"]["options"] == [["--gait", "gait"]]
    assert "--gait" not in commands["walk"]["words"]
    assert commands["walk"]["set"] == ["frequency", "spine.phase"]
    assert f"'{path}'" in commands["replay"]


# --- Python, and the command


def test_show_and_the_command_make_the_same_page(swept: Path, tmp_path: Path) -> None:
    out = tmp_path / "page.html"
    result = call("view", swept, "--out", out, "--no-open", "--json")
    assert result.exit_code == 0, result.output
    output = json.loads(result.stdout)
    assert output == {
        "page": str(out),
        "bytes": out.stat().st_size,
        "rows": 36,
        "recordings": 2,
        "opened": False,
    }
    page = show(swept)
    assert page.html == out.read_text(encoding="utf-8")
    assert page.height == 680
    with pytest.raises(DirectoryError, match="is shown alone"):
        show(swept, out)


def test_wrong_use_is_said_in_a_sentence(swept: Path, dropped: Recording, tmp_path: Path) -> None:
    file = dropped.save(tmp_path / "one.npz")
    (tmp_path / "empty").mkdir()
    (tmp_path / "begun").mkdir()
    (tmp_path / "begun" / "run.json").write_text('{"kind": "sweep"}')
    (tmp_path / "tuned").mkdir()
    (tmp_path / "tuned" / "run.json").write_text('{"kind": "tuning"}')
    path, _ = atlas(tmp_path / "atlas")
    (path / "atlas.parquet").write_text("damaged")
    cases = [
        ([swept, file], 2, "is a directory: it has its own page"),
        ([file, "--recordings", "3"], 2, "--recordings is for the page of a directory"),
        ([swept, "--recordings", "-1"], 2, "-1"),
        ([tmp_path / "empty"], 2, "is not a results directory"),
        ([tmp_path / "tuned"], 2, "tuning.yaml: there is no such file"),
        ([tmp_path / "begun"], 1, "holds no results yet"),
        ([path], 1, "atlas.parquet cannot be read"),
        ([tmp_path / "missing"], 2, "does not exist"),
    ]
    for arguments, code, sentence in cases:
        result = call("view", *arguments, "--no-open")
        assert result.exit_code == code, (arguments, result.output)
        assert sentence in result.stderr, (sentence, result.stderr)


def test_experiments_are_shown_one_by_one_or_all_together(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their recordings belong to rows; what is measured in one alone is missing in the others."""
    pretend(monkeypatch)
    run_experiments(["turning", "maze"], tmp_path, engine="c", video=False)
    alone, both = (runs_of(path) for path in (tmp_path / "maze", tmp_path))
    assert (alone.kind, both.kind) == ("experiment", "experiments")
    assert (len(alone.rows), len(both.rows), both.rows.tolist()) == (18, 36, list(range(36)))
    assert {*both.columns} - {*alone.columns} == {"experiment"}
    assert both.columns["experiment"].distinct.tolist() == ["maze", "turning"]
    assert list(recordings_in(tmp_path)) == [3, 21]
    assert commands_of(tmp_path, both)["replay"] == ""
    assert call("view", tmp_path, "--no-open", "--out", tmp_path / "a.html").exit_code == 0
    result = call("compare", tmp_path / "maze", tmp_path / "turning", "--metric", "speed")
    assert result.exit_code == 0, result.stderr
    assert call("plot", tmp_path / "maze", "--x", "frequency", "--y", "speed").exit_code == 0
