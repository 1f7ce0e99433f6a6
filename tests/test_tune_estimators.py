"""Gradient estimators against closed forms of the Gaussian-smoothed gradient."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import norm

from nermo_mjx.optimize.estimators import ESTIMATORS, Exact, Smoothed, estimate, offsets, perturbations

pytestmark = pytest.mark.compiles

SIGMA, TRIALS = 0.5, 2000
POINT = np.array([0.3, -0.8])
MATRIX = jnp.array([[2.0, 1.0], [1.0, 3.0]])
EDGE_AT = 0.5


def quadratic(u):
    """Its smoothed gradient is its gradient at the centre."""
    return 0.5 * u @ MATRIX @ u - u[0]


def sine(u):
    """E cos(u + s e) = cos(u) exp(-s^2 / 2): each component is damped by its own wave number."""
    return jnp.sin(2.0 * u[0]) + jnp.cos(3.0 * u[1])


def step(u):
    """Its derivative is 0 wherever it has one; smoothed, it is a normal density."""
    return jnp.where(u[0] > EDGE_AT, 2.0, 0.0) + u[1]


def rough(u):
    """A bowl under ripples, so fine that smoothing leaves nothing of them, and so steep that derivatives are noise."""
    return (u**2).sum() + 0.02 * jnp.sin(200.0 * u).sum()


TRUE = {
    quadratic: np.asarray(MATRIX) @ POINT - [1.0, 0.0],
    sine: np.array(
        [
            2 * np.cos(2 * POINT[0]) * np.exp(-0.5 * (2 * SIGMA) ** 2),
            -3 * np.sin(3 * POINT[1]) * np.exp(-0.5 * (3 * SIGMA) ** 2),
        ]
    ),
    step: np.array([2 * norm.pdf((EDGE_AT - POINT[0]) / SIGMA) / SIGMA, 1.0]),
    rough: 2 * POINT,
}


@functools.cache
def trials(name, function, samples=32, ok=None, trials=TRIALS):
    """The estimate in so many independent trials, one "start" each; `ok(points)` says which worlds count."""
    estimator = Exact() if name == "exact" else ESTIMATORS[name](samples, SIGMA)

    @jax.jit
    def run(key):
        noise = perturbations(estimator, key, jnp.asarray(3), trials, len(POINT))
        points = jnp.asarray(POINT, float) + offsets(estimator, noise)
        value, gradient = jax.vmap(jax.vmap(jax.value_and_grad(function)))(points)
        good = jnp.ones(value.shape, bool) if ok is None else ok(points)
        value, gradient = jnp.where(good, value, jnp.nan), jnp.where(good[..., None], gradient, jnp.nan)
        return estimate(estimator, noise, value, gradient if estimator.needs_gradient else None, good)

    return run(jax.random.key_data(jax.random.key(11)))


def mean_and_error(found):
    gradient = np.asarray(found.gradient, float)
    return gradient.mean(axis=0), gradient.std(axis=0) / np.sqrt(len(gradient))


def test_exact_is_the_derivative_at_the_point():
    """One world, no noise, no standard error."""
    found = trials("exact", sine, trials=1)
    np.testing.assert_allclose(found.gradient[0], [2 * np.cos(0.6), -3 * np.sin(-2.4)], rtol=1e-5)
    assert np.isnan(found.error).all()
    assert int(found.discarded[0]) == 0


@pytest.mark.parametrize("function", TRUE, ids=lambda each: each.__name__)
@pytest.mark.parametrize("name", ["smoothed", "evolution"])
def test_both_orders_are_unbiased(name, function):
    """The mean of 2000 estimates is the smoothed gradient to four of its standard errors; but derivatives miss steps.

    Float32 adds up to 1e-4 where there is no variance at all.
    """
    mean, error = mean_and_error(trials(name, function))
    expected = TRUE[function].copy()
    if name == "smoothed" and function is step:
        expected[0] = 0.0
    np.testing.assert_array_less(np.abs(mean - expected), 4 * error + 1e-4)


@pytest.mark.parametrize("function", TRUE, ids=lambda each: each.__name__)
@pytest.mark.parametrize("name", ["smoothed", "evolution"])
def test_standard_errors_are_as_large_as_the_scatter(name, function):
    """The root mean square of the claimed errors is the scatter of the estimates, within 10 %."""
    found = trials(name, function)
    claimed = np.sqrt((np.asarray(found.error, float) ** 2).mean(axis=0))
    scatter = np.asarray(found.gradient, float).std(axis=0)
    np.testing.assert_allclose(claimed, scatter, rtol=0.1, atol=1e-4)


def test_half_of_a_pair_is_the_others_baseline():
    """The level of the objective does not reach the zeroth order's variance: adding 1000 changes rounding only."""
    plain = trials("evolution", sine)
    raised = trials("evolution", lambda u: sine(u) + 1000.0)
    np.testing.assert_allclose(mean_and_error(raised)[1], mean_and_error(plain)[1], rtol=0.02)


@pytest.mark.parametrize("function", [quadratic, sine, rough], ids=lambda each: each.__name__)
def test_the_mixture_is_no_worse_than_either(function):
    """Where both orders are right, its scatter is at most the smaller one of theirs (5 % for the scatter's own error),
    and its bias, which comes from weights made of the same samples, is below a fifth of one estimate's error.
    """
    first, zeroth, both = (
        np.asarray(trials(name, function).gradient, float) for name in ("smoothed", "evolution", "mixture")
    )
    smaller = np.minimum(first.std(axis=0), zeroth.std(axis=0))
    assert (both.std(axis=0) <= 1.05 * smaller + 1e-4).all()
    assert (np.abs(both.mean(axis=0) - TRUE[function]) <= 0.2 * smaller + 1e-4).all()


def test_the_mixture_beats_both_where_neither_is_good():
    """On ripples the two orders are about equally good, and the mixture is better than both."""
    first, zeroth, both = (
        np.asarray(trials(name, rough).gradient, float).std(axis=0) for name in ("smoothed", "evolution", "mixture")
    )
    assert both[0] < 0.85 * min(first[0], zeroth[0])


@pytest.mark.parametrize(("samples", "share"), [(8, 0.5), (32, 0.65), (256, 0.9)])
def test_the_mixture_sees_the_step_that_derivatives_do_not(samples, share):
    """Empirical bias: the first order says 0 with variance 0. The more samples, the less weight is left to it.

    Of the slope beside the step, where the first order is right, at least the same share is found.
    """
    found = trials("mixture", step, samples)
    assert (mean_and_error(found)[0] > share * TRUE[step]).all()
    assert (mean_and_error(found)[0] < 1.05 * TRUE[step]).all()
    assert float((found.gradient[:, 0] == 0).mean()) < 0.05


def test_the_mixture_trusts_exact_derivatives():
    """On a bowl the derivatives explain every difference of values, and have all the weight."""
    found = trials("mixture", quadratic)
    np.testing.assert_allclose(found.first_order, 1.0, atol=1e-3)


def test_the_same_key_gives_the_same_noise():
    """Common random numbers: for both orders always, and on demand for all starts, all iterations, or both."""
    key = jax.random.key_data(jax.random.key(0))

    def noise(common, iteration, name="smoothed"):
        return np.asarray(perturbations(ESTIMATORS[name](6, 0.1, common), key, jnp.asarray(iteration), 3, 2))

    np.testing.assert_array_equal(noise("none", 4), noise("none", 4, "evolution"))
    for common in ("none", "starts", "iterations", "both"):
        now, later = noise(common, 4), noise(common, 5)
        assert (now[0] == now[1]).all() == (common in ("starts", "both"))
        assert (now == later).all() == (common in ("iterations", "both"))
    assert not (
        noise("none", 4)
        == np.asarray(perturbations(Smoothed(6, 0.1), jax.random.key_data(jax.random.key(1)), jnp.asarray(4), 3, 2))
    ).any()


@pytest.mark.parametrize("name", ["exact", "smoothed", "evolution", "mixture"])
def test_what_did_not_walk_is_left_out_and_counted(name):
    """Worlds with NaN never reach the estimate; all of them lost is a zero gradient and a flag."""
    mixed = trials(name, sine, 32, lambda points: points[..., 0] < 0.9)
    everything = 33 if name != "exact" else 1
    assert np.isfinite(mixed.gradient).all()
    assert not np.asarray(mixed.lost).any()
    if name != "exact":
        assert 0 < np.asarray(mixed.discarded).mean() < 10
        assert np.isfinite(mixed.error).all()
    none = trials(name, sine, 32, lambda points: jnp.zeros(points.shape[:-1], bool))
    np.testing.assert_array_equal(none.gradient, 0.0)
    assert np.asarray(none.lost).all()
    np.testing.assert_array_equal(none.discarded, everything)


def test_the_centre_stands_in_for_the_half_that_fell():
    """One half of each pair falls: differences from the centre still give the slope of a linear function."""

    def half(points):
        return points[..., 1] <= POINT[1] + 1e-6

    found = trials("evolution", lambda u: 3.0 * u[0] - 2.0 * u[1], 32, half)
    mean, error = mean_and_error(found)
    np.testing.assert_array_less(np.abs(mean - [3.0, -2.0]), 4 * error + 1e-4)
    np.testing.assert_array_equal(found.discarded, 16)
    # Without the centre there is nothing to compare the other half with: all worlds are left out.
    alone = trials("evolution", sine, 32, lambda points: points[..., 1] < POINT[1] - 1e-6)
    assert np.asarray(alone.lost).all()
    np.testing.assert_array_equal(alone.discarded, 33)


def test_less_than_two_pairs_have_no_standard_error():
    """One pair gives a gradient, no error, and equal weights."""
    assert np.isnan(trials("smoothed", sine, 2).error).all()
    pair = jnp.array([True, True, False, False, False, True, False, False, False])
    one = trials("mixture", sine, 8, lambda points: jnp.broadcast_to(pair, points.shape[:-1]))
    np.testing.assert_array_equal(one.first_order, 0.5)
    assert np.isfinite(one.gradient).all()
