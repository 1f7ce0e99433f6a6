"""Weighted terms over named metrics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.optimize.objective import OBJECTIVE_METRICS, TRAJECTORY_ERROR, Objective, Term
from nermo_mjx.rollout import METRICS

TERMS = Objective(
    (
        Term(maximize="speed", scale=0.1),
        Term(minimize="roll_std", weight=0.5, scale=0.05),
        Term(hold="slip", weight=10, scale=0.005, at=0.05),
    )
)


def test_terms_add_up_as_written():
    """-speed / 0.1 + 0.5 roll_std / 0.05 + 10 ((slip - 0.05) / 0.005)^2, for arrays of any shape."""
    rng = np.random.default_rng(0)
    metrics = {name: rng.random((3, 4)) * 0.1 for name in TERMS.metrics}
    expected = -metrics["speed"] / 0.1 + 0.5 * metrics["roll_std"] / 0.05 + 10 * ((metrics["slip"] - 0.05) / 0.005) ** 2
    np.testing.assert_allclose(TERMS.value(metrics), expected, rtol=1e-5)


def test_it_is_differentiable_under_jit():
    """The derivative to each metric is that of its term."""
    at = {"speed": 0.08, "roll_std": 0.1, "slip": 0.06}
    slope = jax.jit(jax.grad(lambda metrics: TERMS.value(metrics)))(jax.tree.map(jnp.asarray, at))
    assert {name: float(value) for name, value in slope.items()} == pytest.approx(
        {"speed": -10.0, "roll_std": 10.0, "slip": 20 * (0.01 / 0.005) / 0.005}, rel=1e-5
    )


def test_only_what_is_named_is_read():
    """NaN in another metric does no harm; NaN in a named one makes the objective NaN, and no derivative else."""
    found = {"speed": jnp.array([0.1, jnp.nan]), "slip": jnp.array([0.05, 0.05]), "roll_std": jnp.array([0.0, 0.0])}
    value = TERMS.value({**found, "turning_radius": jnp.array([jnp.nan, jnp.nan])})
    np.testing.assert_allclose(value, [-1.0, np.nan], rtol=1e-5)


def test_flags_and_lengths_are_no_aim():
    """Every metric of a walk may be named but those that follow from the run's length, and flags."""
    of_the_run = {"distance", "duration", "fell", "diverged", "failure_time"}
    assert set(OBJECTIVE_METRICS) == set(METRICS) - of_the_run | {TRAJECTORY_ERROR}
    assert all(about.unit for about in OBJECTIVE_METRICS.values())
