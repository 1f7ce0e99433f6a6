# Tests of optimize/tuning_run.py, cli/jobs.py
"""`nermo-mjx tune`, as a user and as a script meet them."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import call, json_of
from fakes.tune_fake import SPEC, FakeProblem, FakeWalker, speed

from nermo_mjx.cli import jobs
from nermo_mjx.optimize import Tuning
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.runs import codes_of, stamp


@pytest.fixture
def spec(tmp_path: Path) -> Path:
    """The file of a small tuning."""
    path = tmp_path / "tuning.yaml"
    path.write_text(Tuning.from_dict(SPEC).to_yaml())
    return path


@pytest.fixture
def fakes(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Simulations in closed form; how the next problem behaves, what was made, and what walked."""
    created: dict[str, Any] = {"options": {}, "problems": [], "walker": FakeWalker()}

    def problem(tuning: Tuning, simulator: Any = None) -> Any:
        if simulator is not None:  # which walks from unseen starts
            return WalkProblem(tuning, simulator=simulator)
        created["problems"].append(FakeProblem(tuning, **created["options"]))
        return created["problems"][-1]

    monkeypatch.setattr("nermo_mjx.optimize.tuning_run.WalkProblem", problem)
    monkeypatch.setattr("nermo_mjx.optimize.tuning_run.Simulator", lambda *_: created["walker"])
    monkeypatch.setattr("nermo_mjx.optimize.tuning_run.measure_pace", lambda _: 100.0)
    return created


# --- tune


@pytest.mark.release
def test_tune_json_is_one_object_in_si_units(
    fakes: dict[str, Any], spec: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    result = json_of("tune", spec, "--out", out)
    assert set(result) == {"out", "iterations_run", "start", "best", "plots", "notes"}
    assert result["best"] == json.loads((out / "best.json").read_text())
    assert result["start"]["parameters"]["spine.phase"] == pytest.approx(2.5)
    assert result["start"]["metrics"]["speed"] == pytest.approx(float(speed(0.05, 2.5)))
    assert (result["iterations_run"], result["plots"], result["notes"]) == (7, [], [])
    again = json_of("tune", spec, "--out", out)
    assert (again["iterations_run"], again["best"]) == (0, result["best"])
    assert len(fakes["problems"]) == 1


@pytest.mark.release
def test_options_stand_for_fields_of_the_file(
    fakes: dict[str, Any], spec: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    spec.write_text(spec.read_text().replace("plots: false", "plots: true"))
    options = ("--iterations", "2", "--starts", "3", "--seed", "8")
    result = json_of("tune", spec, "--out", out, *options)
    tuning = Tuning.from_file(out / "tuning.yaml")
    assert (tuning.iterations, tuning.starts, tuning.seed, tuning.plots) == (2, 3, 8, True)
    assert [Path(path).name for path in result["plots"]] == [
        f"{name}.{form}"
        for name in ("objective", "parameters", "gradients", "path")
        for form in ("png", "svg")
    ]
    # A sweep of 272 rows: five chunks of equal size, of which the last is filled up.
    assert fakes["walker"].batches == [(55, False)] * 5


@pytest.mark.release
def test_tune_prints_start_and_best_as_people_read_them(
    fakes: dict[str, Any], spec: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    result = call("tune", spec, "--out", out)
    assert result.exit_code == 0
    best = json.loads((out / "best.json").read_text())
    phase, pace = np.degrees(best["parameters"]["spine.phase"]), 1e3 * best["metrics"]["speed"]
    assert re.search(
        rf"^spine\.phase +143\.2 +{phase:.4g} +[-+][\d.]+ +deg$", result.stdout, re.MULTILINE
    )
    before = 1e3 * float(speed(0.05, 2.5))
    pattern = rf"{before:.4g} +{pace:.4g}"
    assert re.search(rf"^speed +{pattern} +\+[\d.]+ +{pattern} +mm/s$", result.stdout, re.MULTILINE)
    assert re.search(r"^objective( +-0\.\d+){5} +lower is better$", result.stdout, re.MULTILINE)
    assert "Engine c: means of 8 walks from unseen starts; the best gave -" in result.stdout
    assert "Iteration 6 of start" in result.stdout
    assert (
        "6 iterations in the profile exact (3 min 30 s simulated, gradients at their cost, in "
        in result.stdout
    )
    for name in ("best.json", "history.parquet", "tuned.yaml"):
        assert str(out / name) in result.stdout
    assert str(out / "plots") not in result.stdout
    assert re.search(
        r"^tune: 100%, 7 of 7 evaluations, .*, best -0\.\d+, speed [\d.]+ mm/s",
        result.stderr,
        re.MULTILINE,
    )
    quiet = call("tune", spec, "--out", tmp_path / "quiet", "--quiet")
    assert (quiet.exit_code, quiet.stdout, quiet.stderr) == (0, "", "")


@pytest.mark.parametrize(
    ("name", "change", "shown"),
    [
        ("spine.phase", 6.0, 6.0 - 2 * np.pi),
        ("spine.phase", -0.5, -0.5),
        ("spine.amplitude", 0.3, 0.3),
    ],
)
def test_the_change_of_an_angle_is_the_shorter_way_round(
    name: str, change: float, shown: float
) -> None:
    assert jobs._shortest_change(Tuning.from_dict(SPEC), name, change) == pytest.approx(
        shown, abs=1e-5
    )


def test_a_start_that_falls_is_said_so(fakes: dict[str, Any], spec: Path, tmp_path: Path) -> None:
    fakes["options"] = {"falls": lambda points: points[:, 0] < 0.06}
    result = call("tune", spec, "--out", tmp_path / "out", "--starts", "4")
    assert result.exit_code == 0
    assert "From the given start, the robot did not complete the walk." in result.stdout
    assert re.search(r"^speed +- +[\d.]+ +- +[\d.]+ +[\d.]+ +mm/s$", result.stdout, re.MULTILINE)


def test_failures_and_wrong_use_have_their_exit_codes(
    fakes: dict[str, Any], spec: Path, tmp_path: Path
) -> None:
    missing = call("tune", tmp_path / "missing.yaml", "--out", tmp_path / "out")
    assert (missing.exit_code, missing.stdout) == (2, "")
    assert "there is no such file" in missing.stderr
    text = spec.read_text()
    spec.write_text(text.replace("spine.phase:", "spine.phse:"))
    wrong = call("tune", spec, "--out", tmp_path / "out")
    assert wrong.exit_code == 2
    assert "spine.phase" in wrong.stderr
    assert f"{spec}:" in wrong.stderr
    assert not (tmp_path / "out").exists()
    spec.write_text(text)
    assert call("tune", spec).exit_code == 2
    assert call("tune", spec, "--out", tmp_path / "out", "--iterations", "0").exit_code == 2
    fakes["options"] = {"falls": lambda points: points[:, 0] > -1.0}
    fell = call("tune", spec, "--out", tmp_path / "out", "--quiet")
    assert (fell.exit_code, fell.stdout) == (1, "")
    assert fell.stderr.startswith("nermo-mjx: ")
    assert "choose other starts or bounds" in fell.stderr


@pytest.mark.release
@pytest.mark.usefixtures("fakes")
def test_a_directory_of_a_removed_method_names_its_replacement(spec: Path, tmp_path: Path) -> None:
    """A tuning by CMA-ES, which an earlier release began: one sentence each, and nothing changes."""
    out = tmp_path / "out"
    assert call("tune", spec, "--out", out).exit_code == 0
    stored = out / "tuning.yaml"
    stored.write_text(stored.read_text() + "video: false\n")
    assert call("plot", out).exit_code == 0, "of an earlier release, by gradient"
    stored.write_text(stored.read_text() + "method: {cma: {population: 16}}\n")
    before = stored.read_bytes(), (out / "best.json").read_bytes()
    for command in (("tune", spec, "--out", out), ("tune", stored, "--out", out), ("plot", out)):
        result = call(*command)
        assert (result.exit_code, result.stdout) == (2, ""), result.stderr
        assert (
            "field 'method' is 'cma', which was removed: run nermo-mjx search with method: cma"
            in result.stderr
        )
        assert result.stderr.count("\n") == 1
    result = call("status", out)
    assert result.exit_code == 0
    assert "run nermo-mjx search with method: cma" in result.stdout
    assert (stored.read_bytes(), (out / "best.json").read_bytes()) == before


def test_other_code_is_wrong_use_until_it_is_accepted(
    fakes: dict[str, Any], spec: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One sentence and exit code 2; with --accept-new-code it goes on."""
    out = tmp_path / "out"
    fakes["options"] = {"stop_at": 1}
    assert call("tune", spec, "--out", out).exit_code == 1
    fakes["options"] = {}
    here = stamp("another model", "c")
    monkeypatch.setattr("nermo_mjx.optimize.tuning_run.stamp", lambda *_: here)
    refused = call("tune", spec, "--out", out)
    assert (refused.exit_code, refused.stdout) == (2, "")
    assert re.search(
        rf"^nermo-mjx: {out} was made by other code: model \w+, not another model; ",
        refused.stderr,
        re.M,
    )
    assert call("tune", spec, "--out", out, "--accept-new-code").exit_code == 0
    assert here.id in codes_of(out)
