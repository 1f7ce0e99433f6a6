"""Tunings by line search: what they find, what it costs them, that they resume, and what they refuse."""

from __future__ import annotations

import pickle

import jax.numpy as jnp
import numpy as np
import pytest
from test_tune_run import tune
from tune_fake import SPEC, FakeProblem, Three

from nermo_mjx.optimize import Tuning, run_tuning
from nermo_mjx.optimize.estimators import Smoothed, estimate
from nermo_mjx.optimize.methods import initial_state
from nermo_mjx.optimize.optimizers import LineSearch
from nermo_mjx.optimize.problems import SimulatedProblem, WalkProblem
from nermo_mjx.optimize.run import tuner_of

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
