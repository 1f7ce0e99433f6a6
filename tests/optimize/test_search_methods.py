# Tests of optimize/search_methods.py, optimize/search_spec.py, optimize/search_figures.py
"""Parts of a search: coordinates, scores, gradients, what is kept, and the command that a user meets."""

import json
import math
import re
import types

import numpy as np
import pytest
from click.testing import CliRunner
from fakes.search_fake import ATLAS, FRONT, SPEED, FakeSimulator
from tiers import needs

from nermo_mjx.cli import main
from nermo_mjx.optimize import Search, run_search
from nermo_mjx.optimize.search_methods import (
    Scores,
    Space,
    find_cells,
    ranked_cost,
    score_points,
    searcher,
)
from nermo_mjx.optimize.search_run import search_forecast
from nermo_mjx.recording import Recording
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.simulating import PROBE


def space_of(vary):
    return Space(Search.from_dict({**SPEED, "vary": vary}))


def test_coordinates_are_reflected_at_bounds_and_turn_with_angles():
    """Every coordinate is a share of the bounds."""
    space = space_of(
        {"frequency": {"uniform": [0.4, 1.0]}, "spine.phase": {"uniform": [-math.pi, math.pi]}}
    )
    points = np.array([[1.1, 1.1], [-0.2, -0.2], [2.3, 2.3], [0.4, 0.4]])
    np.testing.assert_allclose(
        space.shares(points), [[0.9, 0.1], [0.2, 0.8], [0.3, 0.3], [0.4, 0.4]], atol=1e-12
    )


def test_a_phase_between_narrow_bounds_does_not_turn():
    space = space_of(
        {"spine.phase": {"uniform": [-1.0, 1.0]}, "frequency": {"loguniform": [0.4, 1.0]}}
    )
    assert not space.periodic.any()
    assert space.published_shares[1] == pytest.approx(math.log(0.67 / 0.4) / math.log(1.0 / 0.4))


def test_falls_come_after_broken_constraints_and_these_by_how_much():
    cost = np.array([[-3.0], [-9.0], [-8.0], [np.nan], [-1.0]])
    violation = np.array([0.0, 2.0, 0.5, np.nan, 0.0])
    scores = Scores(cost, np.empty((5, 0)), violation, np.isfinite(violation))
    assert np.argsort(ranked_cost(scores, worst=-1.0)).tolist() == [0, 4, 2, 1, 3]


def test_both_ends_of_a_measures_range_are_in_the_atlas():
    """Eight cells of the speed from 0 to 0.16 m/s times six of the roll from 0 to 0.1 rad; the roll runs fastest."""
    aim = Search.from_dict(ATLAS).aim
    speed = [0.0, 0.16, 0.16, 0.021, 0.1601, -1e-9, np.nan, 0.05]
    roll = [0.0, 0.1, 0.0, 0.051, 0.05, 0.05, 0.05, np.nan]
    cells = find_cells(aim, np.stack([speed, roll], axis=1))
    assert cells.tolist() == [0, 47, 42, 9, -1, -1, -1, -1]


@pytest.mark.release(cases=("cma_me",))
@pytest.mark.parametrize(
    "spec",
    [
        pytest.param(SPEED, id="cma"),
        pytest.param(FRONT, id="nsga2", marks=pytest.mark.extra),
        pytest.param(ATLAS, id="cma_me", marks=pytest.mark.extra),
    ],
)
def test_points_stay_within_the_bounds_whatever_happens(spec):
    """Even if every run falls, or all points are equal."""
    search = Search.from_dict(spec)
    for answer in ("falls", "alike"):
        needs(search.method.library)
        optimizer = searcher(search, 12)
        for _ in range(8):
            shares = optimizer.ask().points
            assert ((shares >= 0) & (shares <= 1)).all()
            n, m, k = len(shares), len(search.aim.measures), 2 if search.aim.pareto else 1
            lost = answer == "falls"
            filler = (
                np.full((n, k), np.nan if lost else 1.0),
                np.full((n, m), np.nan if lost else 0.05),
            )
            optimizer.tell(
                Scores(*filler, np.full(n, np.nan if lost else 0.0), np.full(n, not lost))
            )


def test_what_a_search_costs_is_counted_by_hand(monkeypatch):
    """120 evaluations of two seconds in batches of 12, by a simulator that makes 50 simulated seconds a second."""
    clock = iter([3.0, 3.0 + 12 * PROBE / 50.0])
    monkeypatch.setattr(
        "nermo_mjx.sweep.simulating.time", types.SimpleNamespace(perf_counter=lambda: next(clock))
    )
    cost = search_forecast(Search.from_dict(SPEED), "c", simulator=FakeSimulator())
    assert cost.counts == {
        "evaluations": 120,
        "batches": 10,
        "evaluations_per_batch": 12,
        "runs": 120,
    }
    assert cost.simulated_seconds == pytest.approx(240.0)
    assert cost.wall_seconds == pytest.approx(240.0 / 50.0)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"objective": {"maximize": "sped"}},
            "is the text 'sped': allowed are speed.*did you mean 'speed'",
        ),
        ({"objective": None}, "objective"),
        ({"method": "nsga2"}, "is nsga2, which is not for one objective: allowed are cma, sobol"),
        ({"pareto": [{"maximize": "speed"}, {"minimize": "slip"}]}, "stands beside 'objective'"),
        (
            {"atlas": {"sped": [0, 1, 5]}},
            "is not a metric that can be aimed at.*did you mean 'speed'",
        ),
        ({"atlas": {"speed": [0, 1, 2.5]}}, "has 2.5 cells: expected a whole number"),
        (
            {"atlas": {"speed": [0, 1, 2000], "roll_std": [0, 1, 2000]}},
            "has more than 1,000,000 cells",
        ),
        (
            {"subject_to": {"roll_std": {"max": 0.1, "min": 0.2}}},
            "allows 0.2 to 0.1: the lower one comes first",
        ),
        ({"budget": {"simulated_seconds": 0}}, "expected a finite number above 0"),
        ({"batch": 2}, "is 2: expected a whole number from 4"),
        ({"keep": {"elites": 3}}, "is for an atlas"),
        ({"sample": "grid"}, "is not a field of a search: how points are chosen is the method's"),
        ({"vary": {}}, "is missing or empty: expected bounds"),
        (
            {"randomize": {"paired": ["frequency"]}},
            "randomize.paired. is for a sweep: the draws of a search depend on all of its parameters",
        ),
        ({"set": {"frequency": 0.5}}, "is under 'vary' and also fixed under 'set'"),
    ],
)
def test_wrong_files_get_their_sentence(change, message):
    data = {key: value for key, value in (SPEED | change).items() if value is not None}
    with pytest.raises(SpecError, match=message):
        Search.from_dict(data)


def test_a_metric_of_ones_own_is_aimed_at_measured_and_limited(tmp_path):
    """In all three places; where no file gives it, its name is refused."""
    (tmp_path / "own.py").write_text(
        "from nermo_mjx import metric\n\n\n"
        '@metric(unit="rad/s", better="low", reduce="rms")\n'
        "def yaw_shake(sensors):\n    return sensors.gyro[2]\n"
    )
    own = {
        "objective": {"minimize": "yaw_shake"},
        "subject_to": {"yaw_shake": {"max": 1.0}},
        "atlas": {"yaw_shake": [0.0, 1.0, 10]},
    }
    spec = {key: value for key, value in ATLAS.items() if key not in ("objective", "atlas")} | own
    search = Search.from_dict(spec | {"metrics": str(tmp_path / "own.py")})
    assert search.aim.metrics == ("yaw_shake",)
    assert search.sweep.metrics["yaw_shake"].unit == "rad/s"
    with pytest.raises(SpecError, match="yaw_shake"):
        Search.from_dict(spec)


@pytest.mark.parametrize("spec", [SPEED, FRONT, ATLAS], ids=["cma", "nsga2", "cma_me"])
def test_a_search_reads_back_as_itself(spec):
    search = Search.from_dict(
        spec | {"subject_to": {"slip": {"max": 0.1}}, "randomize": {"repeats": 2}}
    )
    assert Search.from_text(search.to_yaml()) == search


@pytest.mark.release
@pytest.mark.usefixtures("shared_simulators")
def test_the_command_searches_keeps_and_draws(tmp_path):
    """A search of two runs of a fifth of a second each, on MuJoCo C, as a user gives it; status and plot know it."""
    path, out = tmp_path / "search.yaml", tmp_path / "out"
    spec = {
        "run": {"duration": 0.2},
        "vary": {"frequency": {"uniform": [0.6, 0.9]}, "stride": {"uniform": [0.5, 1.0]}},
        "objective": {"maximize": "speed"},
        "budget": 8,
        "batch": 4,
        "keep": {"best": 1},
    }
    path.write_text(Search.from_dict(spec).to_yaml())

    def call(*arguments):
        ran = CliRunner().invoke(main, [str(argument) for argument in arguments])
        assert ran.exit_code == 0, ran.output
        return ran.stdout

    report = json.loads(call("search", path, "--out", out, "--engine", "c", "--json"))
    assert set(report["best"]) >= {"parameters", "objective", "metrics"}
    (file,) = report["recordings"]
    recording = Recording.load(file)
    assert file.endswith(f"recordings/row-{report['best']['row']:06d}.npz")
    assert recording.metadata["metrics"]["speed"] == report["best"]["metrics"]["speed"]
    assert recording.metadata["parameters"]["stride"] == pytest.approx(
        report["best"]["parameters"]["stride"], rel=1e-6
    )
    again = json.loads(call("replay", out, "--row", report["best"]["row"], "--json"))
    assert again["comparison"]["equal"]
    assert again["parameters"] == recording.metadata["parameters"]
    refused = CliRunner().invoke(main, ["replay", str(out), "--row", "8"])
    assert (refused.exit_code, "row is 8: allowed is 0 to 7" in refused.stderr) == (2, True)
    assert (out / "plots/convergence.png").exists()
    state = json.loads(call("status", out, "--json"))
    assert (state["kind"], state["rows_done"], state["complete"], state["engine"]) == (
        "search",
        8,
        True,
        "c",
    )
    files = json.loads(call("plot", out, "--out", tmp_path / "plots", "--json"))["files"]
    assert (tmp_path / "plots/convergence.svg").read_bytes() == (
        out / "plots/convergence.svg"
    ).read_bytes()
    assert len(files) >= 2
    assert "profile exact; 8 evaluations" in (out / "plots/convergence.svg").read_text()
    call("plot", out, "--x", "frequency", "--y", "speed", "--out", tmp_path / "chosen")
    assert "4 evaluations per batch" in call(
        "search", path, "--out", out, "--engine", "c", "--dry-run"
    )


@pytest.mark.usefixtures("shared_simulators")
@pytest.mark.release
def test_the_command_searches_by_a_custom_metric(tmp_path):
    """Its unit is the one that its file declares, while the search runs and at the end."""
    (tmp_path / "shake.py").write_text(
        "from nermo_mjx import metric\n\n\n"
        '@metric(unit="rad/s", better="low", reduce="rms")\n'
        "def shake(sensors):\n    return sensors.gyro[2]\n"
    )
    spec = {
        "run": {"duration": 0.2},
        "metrics": str(tmp_path / "shake.py"),
        "plots": False,
        "budget": 4,
        "batch": 4,
    }
    spec |= {"vary": {"frequency": {"uniform": [0.6, 0.9]}}, "objective": {"minimize": "shake"}}
    path, out = tmp_path / "search.yaml", tmp_path / "out"
    path.write_text(Search.from_dict(spec).to_yaml())
    ran = CliRunner().invoke(main, ["search", str(path), "--out", str(out), "--engine", "c"])
    assert ran.exit_code == 0, ran.output
    best = np.degrees(json.loads((out / "best.json").read_text())["metrics"]["shake"])
    assert re.search(rf"^shake +{best:.4g} +deg/s$", ran.stdout, re.MULTILINE)
    assert f"best shake {best:.4g} deg/s" in ran.stderr


@pytest.mark.extra
@pytest.mark.release(cases=("spec1-names1",))
@pytest.mark.parametrize(
    ("spec", "names"), [(FRONT, ("front", "hypervolume")), (ATLAS, ("atlas", "coverage"))]
)
def test_fronts_and_atlases_are_drawn(spec, names, tmp_path):
    needs("pymoo", "ribs")
    result = run_search(
        spec | {"plots": True, "budget": 40}, tmp_path / "out", simulator=FakeSimulator()
    )
    assert {f"{name}.{form}" for name in names for form in ("png", "svg")} <= {
        path.name for path in result.plots
    }


def test_a_point_with_a_lost_run_comes_after_all_without():
    """One run of two fell, or has no number for what is asked, however fast the other: as for best variants."""
    aim = Search.from_dict({**SPEED, "randomize": {"repeats": 2}}).aim
    speed = {"speed": np.array([0.1, 0.1, 9.0, 9.0, 9.0, np.nan, 0.2, 0.2])}
    scores = score_points(
        aim, 2, speed, np.array([True, True, True, False, True, True, True, True])
    )
    assert scores.ok.tolist() == [True, False, False, True]
    assert np.argsort(ranked_cost(scores, 0.0), kind="stable").tolist() == [3, 0, 1, 2]
