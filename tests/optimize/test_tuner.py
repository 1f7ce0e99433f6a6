# Tests of optimize/tuner.py
"""Tunings by differences: their results and their cost."""

from __future__ import annotations

import json
import math
import types
from pathlib import Path

import numpy as np
import pytest
from command import call
from fakes.tune_fake import BEST, SPEC, FakeProblem

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.optimize.problems import WalkProblem
from nermo_mjx.optimize.tuning_run import tuning_forecasts
from nermo_mjx.runs import Interrupted, codes_of

DIFFERENCES = SPEC | {"method": "wide_differences"}


class Walker:
    """A simulator in closed form, in float64; the robot falls above an amplitude."""

    def __init__(self, falls_above=math.inf):
        self.batches, self.falls_above, self.engine = [], falls_above, "c"

    def run(self, values, run):
        amplitude, phase = values["spine.amplitude"], values["spine.phase"]
        self.batches.append(np.stack([amplitude, phase], axis=-1))
        pace = 0.1 - 0.5 * (amplitude - BEST[0]) ** 2 - 0.02 * (1 - np.cos(phase - BEST[1]))
        status = np.where(amplitude > self.falls_above, "fell", "ok")
        return types.SimpleNamespace(
            metrics={"speed": pace, "roll_std": 0.1 + 0.1 * amplitude**2}, status=status
        )


def problem(spec, **how):
    tuning = Tuning.from_dict(spec)
    return WalkProblem(tuning, simulator=Walker(**how)), tuning


def slope_of(amplitude, phase):
    """d objective / d (amplitude, phase) of `SPEC` in closed form."""
    by_amplitude = (amplitude - BEST[0]) / 0.1 + 0.1 * 0.2 * amplitude / 0.05
    return np.stack([by_amplitude, 0.02 * np.sin(phase - BEST[1]) / 0.1], axis=-1)


def test_central_differences_are_the_slope():
    """Of a parabola they are exact; of a cosine short by the sine of the step."""
    result, _ = problem(DIFFERENCES)
    points = np.array([[0.1, 0.5], [0.3, -2.0]])
    slope = result.evaluate(points, True).gradient
    step = 0.02 * 2 * math.pi
    expected = slope_of(points[:, 0], points[:, 1]) * [1.0, math.sin(step) / step]
    np.testing.assert_allclose(slope, expected, rtol=1e-5)
    assert result.gradient_cost == 5.0
    assert result.simulator.batches[0].shape == (10, 2)


def test_differences_stay_within_the_bounds():
    """At a bound a neighbour stands on it; a periodic parameter's comes back at the other side; slopes are right."""
    for scheme in ("central", "forward"):
        spec = DIFFERENCES | {"method": {"wide_differences": {"scheme": scheme, "step": 0.01}}}
        result, _ = problem(spec)
        slope = result.evaluate(np.array([[0.399, 3.14], [0.0005, -3.14]]), True).gradient
        worlds = result.simulator.batches[0]
        assert (worlds[:, 0] >= 0).all()
        assert (worlds[:, 0] <= 0.4).all()
        assert (np.abs(worlds[:, 1]) <= math.pi + 1e-6).all()
        np.testing.assert_allclose(
            slope, slope_of(np.array([0.399, 0.0005]), np.array([3.14, -3.14])), atol=0.04
        )


def test_a_point_counts_as_fallen_if_a_neighbour_falls():
    result, _ = problem(DIFFERENCES, falls_above=0.2)
    assert result.evaluate(np.array([[0.1, 0.0], [0.199, 0.0]]), True).ok.tolist() == [True, False]


@pytest.mark.release
def test_differences_tune_to_the_closed_form(tmp_path: Path) -> None:
    """With the same optimizer as by gradient; best.json and history have the same form."""
    spec = DIFFERENCES | {"iterations": 30}
    evaluation, _ = problem(spec)
    result = run_tuning(spec, tmp_path / "out", problem=evaluation)
    assert result.best["metrics"]["speed"] == pytest.approx(0.1, abs=4e-3)
    assert {"gradient.spine.phase", "objective", "iteration"} <= set(result.history.schema.names)
    assert [code.engine for code in codes_of(tmp_path / "out").values()] == ["c"]


def test_each_method_says_its_cost_before(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """At a hundred simulated seconds a second: counted by hand for two starts, six iterations, runs of five seconds."""
    monkeypatch.setattr("nermo_mjx.optimize.tuning_run.measure_pace", lambda _: 100.0)
    costs = {
        forecast.method: forecast for forecast in tuning_forecasts(Tuning.from_dict(DIFFERENCES))
    }
    assert list(costs) == ["wide_differences", "local_gradient"]
    assert costs["wide_differences"].counts["evaluations"] == 2 * 7 * 5
    assert costs["wide_differences"].simulated_seconds == pytest.approx(2 * 7 * 5 * 5.0)
    assert costs["wide_differences"].wall_seconds == pytest.approx(3.5)
    assert costs["local_gradient"].simulated_seconds == pytest.approx(2 * 7 * 5 * 5.0)
    path = tmp_path / "tuning.yaml"
    path.write_text(Tuning.from_dict(DIFFERENCES).to_yaml())
    output = call("tune", path, "--out", tmp_path / "out", "--dry-run").stdout
    assert "method wide_differences: 70 evaluations;" in output
    assert "instead of it, method local_gradient: 70 evaluations;" in output
    assert "minutes to compile" not in output, "nothing here runs in MJX"
    assert not (tmp_path / "out").exists()


@pytest.mark.release
def test_a_stopped_tuning_ends_with_the_same_numbers(tmp_path: Path) -> None:
    spec = DIFFERENCES
    tuning = Tuning.from_dict(spec)
    whole = run_tuning(spec, tmp_path / "a", problem=FakeProblem(tuning))
    with pytest.raises(Interrupted):
        run_tuning(spec, tmp_path / "b", problem=FakeProblem(tuning, stop_at=4))
    rest = run_tuning(spec, tmp_path / "b", problem=(fake := FakeProblem(tuning)))
    assert len(fake.batches) == tuning.iterations + 1 - 4
    drop = ["wall_seconds", "code"]
    assert rest.history.drop_columns(drop).equals(whole.history.drop_columns(drop))
    assert json.loads((tmp_path / "b/best.json").read_text()) == json.loads(
        (tmp_path / "a/best.json").read_text()
    )
