"""Tunings by CMA-ES, by differences and by line search: their results and their cost."""

from __future__ import annotations

import json
import math
import pickle
import types
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from command import call
from test_tune_run import tune
from tune_fake import BEST, SPEC, FakeProblem, Three, speed

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.optimize.estimators import Smoothed, estimate
from nermo_mjx.optimize.methods import initial_state
from nermo_mjx.optimize.optimizers import LineSearch
from nermo_mjx.optimize.problems import SimulatedProblem, WalkProblem
from nermo_mjx.optimize.run import costs_of, tuner_of
from nermo_mjx.runs import Interrupted, codes_of

PLAIN = {key: value for key, value in SPEC.items() if key not in ("optimizer", "starts")}
CMA = PLAIN | {"method": {"cma": {"population": 8}}, "iterations": 12}
DIFFERENCES = SPEC | {"method": "differences"}


class Walker:
    """A simulator in closed form, in float64; the robot falls above an amplitude."""

    def __init__(self, falls_above=math.inf):
        self.batches, self.falls_above, self.engine = [], falls_above, "c"

    def run(self, values, run):
        amplitude, phase = values["spine.amplitude"], values["spine.phase"]
        self.batches.append(np.stack([amplitude, phase], axis=-1))
        pace = 0.1 - 0.5 * (amplitude - BEST[0]) ** 2 - 0.02 * (1 - np.cos(phase - BEST[1]))
        status = np.where(amplitude > self.falls_above, "fell", "ok")
        return types.SimpleNamespace(metrics={"speed": pace, "roll_std": 0.1 + 0.1 * amplitude**2}, status=status)


def problem(spec, **how):
    tuning = Tuning.from_dict(spec)
    return SimulatedProblem(tuning, simulator=Walker(**how)), tuning


def slope_of(amplitude, phase):
    """d objective / d (amplitude, phase) of `SPEC` in closed form."""
    by_amplitude = (amplitude - BEST[0]) / 0.1 + 0.1 * 0.2 * amplitude / 0.05
    return np.stack([by_amplitude, 0.02 * np.sin(phase - BEST[1]) / 0.1], axis=-1)


def test_central_differences_are_the_slope():
    """Of a parabola they are exact; of a cosine short by the sine of the step."""
    found, _ = problem(DIFFERENCES)
    points = np.array([[0.1, 0.5], [0.3, -2.0]])
    slope = found.evaluate(points, True).gradient
    step = 0.02 * 2 * math.pi
    expected = slope_of(points[:, 0], points[:, 1]) * [1.0, math.sin(step) / step]
    np.testing.assert_allclose(slope, expected, rtol=1e-5)
    assert found.gradient_cost == 5.0
    assert found.simulator.batches[0].shape == (10, 2)


def test_differences_stay_within_the_bounds():
    """At a bound a neighbour stands on it; a periodic parameter's comes back at the other side; slopes are right."""
    for scheme in ("central", "forward"):
        spec = DIFFERENCES | {"method": {"differences": {"scheme": scheme, "step": 0.01}}}
        found, _ = problem(spec)
        slope = found.evaluate(np.array([[0.399, 3.14], [0.0005, -3.14]]), True).gradient
        worlds = found.simulator.batches[0]
        assert (worlds[:, 0] >= 0).all()
        assert (worlds[:, 0] <= 0.4).all()
        assert (np.abs(worlds[:, 1]) <= math.pi + 1e-6).all()
        np.testing.assert_allclose(slope, slope_of(np.array([0.399, 0.0005]), np.array([3.14, -3.14])), atol=0.04)


def test_a_point_counts_as_fallen_if_a_neighbour_falls():
    found, _ = problem(DIFFERENCES, falls_above=0.2)
    assert found.evaluate(np.array([[0.1, 0.0], [0.199, 0.0]]), True).ok.tolist() == [True, False]


@pytest.mark.compiles
def test_differences_tune_to_the_closed_form(tmp_path: Path) -> None:
    """With the same optimizer as by gradient; best.json and history have the same form."""
    spec = DIFFERENCES | {"iterations": 30}
    found, _ = problem(spec)
    result = run_tuning(spec, tmp_path / "out", problem=found)
    assert result.best["metrics"]["speed"] == pytest.approx(0.1, abs=4e-3)
    assert {"gradient.spine.phase", "objective", "iteration"} <= set(result.history.schema.names)
    assert [code.engine for code in codes_of(tmp_path / "out").values()] == ["c"]


@pytest.mark.compiles
def test_generations_tune_to_the_closed_form(tmp_path: Path) -> None:
    """The first point is the given one; there are no gradients, and each generation is a row a point."""
    found, tuning = problem(CMA)
    result = run_tuning(CMA, tmp_path / "out", problem=found)
    assert tuning.starts == 8
    assert result.history.num_rows == 8 * 13
    assert result.best["metrics"]["speed"] > 0.097
    assert result.start["parameters"] == pytest.approx({"spine.amplitude": 0.05, "spine.phase": 2.5})
    assert not any(name.startswith("gradient") for name in result.history.schema.names)
    assert result.best["objective"] == pytest.approx(min(result.history.column("objective").to_pylist()))


@pytest.mark.compiles
def test_falls_cost_a_generation_nothing_but_themselves(tmp_path: Path) -> None:
    """Where the best would fall, the best that does not is found."""
    found, _ = problem(CMA, falls_above=0.2)
    best = run_tuning(CMA, tmp_path / "out", problem=found).best
    assert best["parameters"]["spine.amplitude"] <= 0.2
    assert best["metrics"]["speed"] > float(speed(0.2)) - 4e-3


def test_each_method_says_its_cost_before(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """At a hundred simulated seconds a second: counted by hand for two starts, six iterations, runs of five seconds."""
    monkeypatch.setattr("nermo_mjx.optimize.run.pace_here", lambda _: 100.0)
    costs = {each.method: each for each in costs_of(Tuning.from_dict(DIFFERENCES))}
    assert list(costs) == ["differences", "gradient", "cma"]
    assert costs["differences"].evaluations == 2 * 7 * 5
    assert costs["differences"].simulated_seconds == pytest.approx(2 * 7 * 5 * 5.0)
    assert costs["differences"].wall_seconds == pytest.approx(3.5)
    assert costs["gradient"].simulated_seconds == pytest.approx(2 * 7 * 3 * 5.0)
    assert costs["cma"].evaluations == 16 * 7
    line = SPEC | {"optimizer": "line_search"}
    averaged, values, differences = (
        costs_of(Tuning.from_dict(line | more))[0]
        for more in (
            {"estimator": {"smoothed": {"samples": 4, "sigma": 0.1, "normalized": True}}},
            {"estimator": {"evolution": {"samples": 8, "sigma": 0.1}}},
            {"method": "differences"},
        )
    )
    assert averaged.evaluations == 7 * (8 + 34)
    assert averaged.simulated_seconds == pytest.approx(7 * (8 * 3 + 34) * 5.0)  # forward mode: 1 + 2 runs
    assert averaged.wall_seconds == pytest.approx(7 * (8 * 3 * 10 + 34) * 5.0 / 100)
    assert values.wall_seconds == pytest.approx(7 * (16 + 34) * 5.0 / 100)
    assert differences.evaluations == 7 * 2 * (5 + 17)
    path = tmp_path / "tuning.yaml"
    path.write_text(Tuning.from_dict(DIFFERENCES).to_yaml())
    shown = call("tune", path, "--out", tmp_path / "out", "--dry-run").stdout
    assert "method differences: 70 evaluations" in shown
    assert "instead of it, method gradient" in shown
    assert not (tmp_path / "out").exists()


AVERAGED = {"smoothed": {"samples": 4, "sigma": 0.1, "normalized": True}}
SEARCH = SPEC | {"optimizer": "line_search", "estimator": AVERAGED}
EXACT = SEARCH | {"estimator": "exact"}
VALUES = SEARCH | {"estimator": {"evolution": {"samples": 8, "sigma": 0.1}}}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The tuning along averaged gradients, run without a stop."""
    return tune(tmp_path_factory.mktemp("whole"), SEARCH)


@pytest.mark.compiles
@pytest.mark.parametrize("spec", [EXACT, SEARCH, VALUES], ids=["exact", "averaged", "evolution"])
def test_six_searches_find_the_optimum(spec, tmp_path, whole):
    """From the slow side of the circle, in fewer steps than an optimizer with a learning rate takes."""
    result = whole[0] if spec is SEARCH else tune(tmp_path, spec)[0]
    assert result.best["metrics"]["speed"] > 0.0985
    value = result.history.column("objective").to_numpy().reshape(-1, 2)
    assert (np.diff(value, axis=0) <= 0).all()  # where nothing is better, it stays


@pytest.mark.compiles
def test_gradients_are_few_and_walks_many(whole):
    """Two starts: four points each with gradients, without the start itself; it and 16 points on lines, without."""
    result, problem = whole
    assert problem.batches == [(8, True), (34, False)] * 7
    assert result.best["simulated_seconds"] == 7 * (8 * 3 + 34) * 5.0
    assert problem.compiled == 2
    assert not np.array(result.history.column("discarded")).any()


@pytest.mark.compiles
def test_the_first_iteration_is_the_given_start(whole):
    """Its column of gradients has the mean direction, of length 1 at most in the tuner's coordinates."""
    result, _ = whole
    assert result.start["parameters"] == pytest.approx({"spine.amplitude": 0.05, "spine.phase": 2.5})
    row = result.history.slice(0, 1).to_pylist()[0]
    # dx/du: of the amplitude range * share * (1 - share), of the phase range / 4.
    slopes = 0.4 * 0.125 * 0.875, 2 * np.pi / 4
    length = np.hypot(row["gradient.spine.amplitude"] * slopes[0], row["gradient.spine.phase"] * slopes[1])
    assert 0.9 < length < 1.0 + 1e-5
    assert row["gradient.spine.amplitude"] < 0  # a larger one is faster
    assert np.isfinite(row["gradient_error.spine.phase"])


@pytest.mark.compiles
def test_workers_find_what_one_process_finds(whole, tmp_path):
    """Two starts on three workers: shares of one start, of either kind of batch."""
    log = tmp_path / "log"
    tuning = Tuning.from_dict(SEARCH)
    shared = run_tuning(SEARCH, tmp_path / "out", problem=FakeProblem(tuning, log=log), workers=Three())
    assert shared.best["objective"] == pytest.approx(whole[0].best["objective"], rel=1e-4)
    assert {int(line.split()[1]) for line in log.read_text().splitlines()} == {4, 17}


@pytest.mark.compiles
def test_the_momentum_leads_where_no_world_walks_with_a_gradient():
    """Gradients are lost in the second iteration: the walks go on along the first one's direction, and none falls."""
    tuning = Tuning.from_dict(SEARCH | {"starts": 1})
    problem, real = FakeProblem(tuning), FakeProblem.evaluate
    tuner, state = tuner_of(tuning, problem), initial_state(tuning)
    state, _ = tuner.step(state)
    momentum, before = np.array(state.optimizer.momentum[0]), float(state.best_value[0])

    def lost(points, gradient):
        found = real(problem, points, gradient)
        return found if not gradient else type(found)(found.value, found.gradient, found.metrics, ~found.ok)

    problem.evaluate = lost
    after, found = tuner.step(state)
    assert found.lost.all()
    assert found.discarded.tolist() == [4]
    assert found.ok.all()
    np.testing.assert_allclose(after.optimizer.momentum[0], 0.5 * momentum, rtol=1e-6)
    assert float(after.best_value[0]) <= before


@pytest.mark.compiles
def test_it_never_moves_to_a_fall(tmp_path):
    """The robot falls above an amplitude of 0.2, short of the best one: it ends below, and close to it."""
    result, _ = tune(tmp_path, SEARCH, falls=lambda points: points[:, 0] > 0.2)
    assert all(result.history.column("ok").to_pylist())
    assert 0.15 < result.best["parameters"]["spine.amplitude"] <= 0.2


@pytest.mark.compiles
def test_one_wild_gradient_does_not_decide():
    """One world of eight has a derivative 10,000 times as long, and opposite: the mean of directions stays right."""
    true, wild = jnp.array([3.0, 4.0]), jnp.zeros((1, 9, 2)).at[0, :].set([3.0, 4.0]).at[0, 5].set([-3e4, -4e4])
    noise, value, ok = jnp.ones((1, 4, 2)), jnp.zeros((1, 9)), jnp.ones((1, 9), bool)
    found = {
        each: estimate(Smoothed(8, 0.1, normalized=each), noise, value, wild, ok).gradient[0] for each in (True, False)
    }
    np.testing.assert_allclose(found[True], true / 5 * 6 / 8, rtol=1e-6)
    assert float(found[False] @ true) < 0


def test_a_line_is_tried_at_many_lengths():
    """Both directions in turn, from an eighth to four times the expected length, which follows what was chosen."""
    search = LineSearch(points=8, momentum=0.5)
    state, tried = search.along(search.init(jnp.zeros(2)), jnp.zeros(2), jnp.array([0.0, 7.0]))
    np.testing.assert_allclose(tried[:, 1], -np.geomspace(1 / 8, 4, 8), rtol=1e-6)
    state = search.taken(state, jnp.array(True), jnp.array(4.0))
    assert float(state.length) == 2.0
    state, tried = search.along(state, jnp.zeros(2), jnp.array([1.0, 0.0]))
    np.testing.assert_allclose(tried[::2, 1], 0.0, atol=1e-7)
    np.testing.assert_allclose(tried[1::2, 1] / tried[1::2, 0], 0.5, rtol=1e-6)  # momentum: (-1, -0.5)
    assert float(search.taken(state, jnp.array(False), jnp.array(0.0)).length) == pytest.approx(1.2)


def test_walks_without_gradients_are_those_of_the_engine_c(monkeypatch):
    """A tuning by line search has its gradients from MJX, and every value that it compares from MuJoCo C."""
    tuning = Tuning.from_dict(SEARCH | {"run": {"duration": 0.1, "warmup": 0.02}, "starts": 1})
    asked = []

    monkeypatch.setattr(WalkProblem, "_part", lambda self, points, gradient: asked.append((gradient, "mjx")))
    monkeypatch.setattr(
        SimulatedProblem,
        "evaluate",
        lambda self, points, gradient: asked.append((gradient, self.simulator.engine.name)),
    )
    problem = pickle.loads(pickle.dumps(WalkProblem(tuning)))
    problem.evaluate(np.zeros((1, 2)), True)
    problem.evaluate(np.zeros((1, 2)), False)
    assert asked == [(True, "mjx"), (False, "c")]


@pytest.mark.compiles
@pytest.mark.parametrize("spec", [CMA, DIFFERENCES], ids=["cma", "differences"])
def test_a_stopped_tuning_ends_with_the_same_numbers(spec, tmp_path: Path) -> None:
    tuning = Tuning.from_dict(spec)
    whole = run_tuning(spec, tmp_path / "a", problem=FakeProblem(tuning))
    with pytest.raises(Interrupted):
        run_tuning(spec, tmp_path / "b", problem=FakeProblem(tuning, stop_at=4))
    rest = run_tuning(spec, tmp_path / "b", problem=(fake := FakeProblem(tuning)))
    assert len(fake.batches) == tuning.iterations + 1 - 4
    drop = ["wall_seconds", "code"]
    assert rest.history.drop_columns(drop).equals(whole.history.drop_columns(drop))
    assert json.loads((tmp_path / "b/best.json").read_text()) == json.loads((tmp_path / "a/best.json").read_text())
