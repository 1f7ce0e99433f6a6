# Tests of optimize/objective.py
"""Weighted terms over named metrics, and unbounded coordinates of bounded and periodic parameters."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from nermo_mjx.optimize import objective
from nermo_mjx.optimize.objective import (
    EDGE,
    FURTHEST,
    OBJECTIVE_METRICS,
    TRAJECTORY_ERROR,
    Bounds,
    Objective,
    ObjectiveTerm,
)
from nermo_mjx.rollout import METRICS

TERMS = Objective(
    (
        ObjectiveTerm(maximize="speed", scale=0.1),
        ObjectiveTerm(minimize="roll_std", weight=0.5, scale=0.05),
        ObjectiveTerm(hold="slip", weight=10, scale=0.005, at=0.05),
    )
)


def test_terms_add_up_as_written():
    """-speed / 0.1 + 0.5 roll_std / 0.05 + 10 ((slip - 0.05) / 0.005)^2, for arrays of any shape."""
    rng = np.random.default_rng(0)
    metrics = {name: rng.random((3, 4)) * 0.1 for name in TERMS.metrics}
    expected = (
        -metrics["speed"] / 0.1
        + 0.5 * metrics["roll_std"] / 0.05
        + 10 * ((metrics["slip"] - 0.05) / 0.005) ** 2
    )
    np.testing.assert_allclose(TERMS.value(metrics), expected, rtol=1e-5)


def test_it_is_differentiable_under_jit():
    """The derivative to each metric is that of its term."""
    point = {"speed": 0.08, "roll_std": 0.1, "slip": 0.06}
    slope = jax.jit(jax.grad(lambda metrics: TERMS.value(metrics)))(
        jax.tree.map(jnp.asarray, point)
    )
    assert {name: float(value) for name, value in slope.items()} == pytest.approx(
        {"speed": -10.0, "roll_std": 10.0, "slip": 20 * (0.01 / 0.005) / 0.005}, rel=1e-5
    )


def test_only_what_is_named_is_read():
    """NaN in another metric does no harm; NaN in a named one makes the objective NaN, and no derivative else."""
    metrics_read = {
        "speed": jnp.array([0.1, jnp.nan]),
        "slip": jnp.array([0.05, 0.05]),
        "roll_std": jnp.array([0.0, 0.0]),
    }
    value = TERMS.value({**metrics_read, "turning_radius": jnp.array([jnp.nan, jnp.nan])})
    np.testing.assert_allclose(value, [-1.0, np.nan], rtol=1e-5)


def test_flags_and_lengths_are_no_aim():
    """Every metric of a walk may be named but those that follow from the run's length, and flags."""
    of_the_run = {"distance", "duration", "fell", "diverged", "failure_time"}
    assert set(OBJECTIVE_METRICS) == set(METRICS) - of_the_run | {TRAJECTORY_ERROR}
    assert all(declaration.unit for declaration in OBJECTIVE_METRICS.values())


to_unconstrained, from_unconstrained = (
    jax.jit(objective.to_unconstrained),
    jax.jit(objective.from_unconstrained),
)
slope, confine = jax.jit(objective.slope), jax.jit(objective.confine)

#: An amplitude, an angle, and a frequency far from 0 whose range is small.
BOUNDS = Bounds(
    low=jnp.array([0.0, -jnp.pi, 100.0]),
    high=jnp.array([0.4, jnp.pi, 100.5]),
    periodic=jnp.array([False, True, False]),
)
INSIDE = np.array([[0.05, 3.0, 100.1], [0.2, 0.0, 100.25], [0.39, -3.1, 100.4]])


def test_there_and_back():
    """What lies inside the bounds comes back as it was, to the digits of float32."""
    back = from_unconstrained(BOUNDS, to_unconstrained(BOUNDS, jnp.asarray(INSIDE)))
    np.testing.assert_allclose(back, INSIDE, rtol=3e-6, atol=3e-7)


@pytest.mark.parametrize("u", [-1e30, -50.0, -3.0, 0.0, 2.0, 50.0, 1e6])
def test_no_coordinate_leads_out_of_the_bounds(u):
    """Whatever an optimizer does, the parameter stays finite and within its bounds."""
    x = from_unconstrained(BOUNDS, jnp.full(3, u))
    assert bool(((x >= BOUNDS.low) & (x <= BOUNDS.high)).all())


def test_the_slope_is_the_derivative():
    """`slope` is what automatic differentiation says, and a quarter of the range in the middle."""
    u = jnp.array([[-2.0, 0.7, 1.3], [0.1, -1.9, 0.0]])
    diagonal = jax.jit(
        jax.vmap(
            lambda row: jnp.diag(
                jax.jacfwd(lambda coordinate: from_unconstrained(BOUNDS, coordinate))(row)
            )
        )
    )
    derivative = diagonal(u)
    np.testing.assert_allclose(slope(BOUNDS, u), derivative, rtol=1e-5)
    np.testing.assert_allclose(
        slope(BOUNDS, jnp.zeros(3)), (BOUNDS.high - BOUNDS.low) / 4, rtol=1e-6
    )


def test_an_angle_walks_round_the_circle():
    """Four units of u are a turn; over the bound it comes back at the other, and nothing in between jumps."""
    u = np.linspace(-3.0, 7.0, 401, dtype=np.float32)
    angle = np.asarray(from_unconstrained(BOUNDS, np.stack([0 * u, u, 0 * u], axis=-1)))[:, 1]
    np.testing.assert_allclose(np.cos(angle), np.cos(u * np.pi / 2), atol=3e-6)
    np.testing.assert_allclose(np.sin(angle), np.sin(u * np.pi / 2), atol=3e-6)
    assert float(angle.max()) > 3.1
    assert float(angle.min()) < -3.1


@pytest.mark.parametrize("end", ["low", "high"])
def test_a_start_on_a_bound_can_leave_it(end):
    """On a bound u would be infinite and its slope zero; the start is taken 1 % of the range inside."""
    x = getattr(BOUNDS, end)
    u = to_unconstrained(BOUNDS, x)
    assert bool(jnp.isfinite(u).all())
    moved = from_unconstrained(BOUNDS, u)
    reach = BOUNDS.high - BOUNDS.low
    np.testing.assert_allclose((jnp.abs(moved - x) / reach)[jnp.array([0, 2])], EDGE, rtol=0.01)
    assert abs(float(moved[1])) == pytest.approx(np.pi, abs=1e-5)
    # A step of half a unit to the inside, such as a few of Adam's, is felt.
    inwards = 0.5 if end == "low" else -0.5
    assert abs(float(from_unconstrained(BOUNDS, u + inwards)[0] - moved[0])) > 0.002


def test_steps_are_confined():
    """Far steps end a thousandth of the range before the bound; an angle may go as far as it likes."""
    u = confine(BOUNDS, jnp.array([90.0, 90.0, -jnp.inf]))
    share = (from_unconstrained(BOUNDS, u) - BOUNDS.low) / (BOUNDS.high - BOUNDS.low)
    assert float(share[0]) == pytest.approx(1 - FURTHEST, rel=1e-3)
    assert float(share[2]) == pytest.approx(FURTHEST, rel=0.1)
    assert float(u[1]) == 90.0
