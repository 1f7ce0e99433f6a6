"""Estimators of an objective's gradient from one batch of worlds: exact, smoothed, by evolution, and their mixture.

Each start has one world at its point u (the centre) and pairs of worlds beside it, at u + sigma e and u - sigma e with
e ~ N(0, I). All estimators but `exact` aim at the gradient of the objective smoothed by this Gaussian,

    F_sigma(u) = E[F(u + sigma e)],

which exists where F itself is rough or jumps. They use the same pairs, so that one batch serves all of them:

    first order    grad F_sigma = E[grad F(u + sigma e)]
    zeroth order   grad F_sigma = E[e (F(u + sigma e) - F(u - sigma e))] / (2 sigma)

The zeroth order is the antithetic evolution strategy (Salimans et al., *Evolution strategies as a scalable alternative
to reinforcement learning*, 2017); the other half of a pair is the baseline that takes the objective's level out of its
variance. If only one half of a pair completed its walk, the centre replaces the other.

The mixture is alpha * first + (1 - alpha) * zeroth for each parameter, after Suh, Simchowitz, Zhang and Tedrake, *Do
differentiable simulators give better policy gradients?* (ICML 2022): least variance, subject to a bound on the bias
that the first order may bring in. On a step function its sample variance and its mean are 0, whatever the true
slope ("empirical bias"), and inverse variances alone would give it all the weight. See `mixture` for the rule.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Annotated, ClassVar, Final

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, UInt

from nermo_mjx.specs.model import Spec
from nermo_mjx.specs.values import Choice, Positive, Whole

# ---
# Placement of the worlds of an estimate: how many, how far from their point, and with which random numbers.


#: For which of a tuning's estimates the perturbations are the same.
COMMON: Final = ("none", "starts", "iterations", "both")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Worlds:
    """Results of the worlds of one start, in k pairs.

    Attributes:
        noise: e of each pair (k, p).
        centre: value at the point itself; centre_ok: whether that world counts.
        value: of both halves of each pair (2, k); ok: whether they count (2, k).
        centre_gradient: (p,) and gradient: (2, k, p), to the coordinates u; zeros where they were not asked for.
    """

    noise: Float[Array, "k p"]
    centre: Float[Array, ""]
    centre_ok: Bool[Array, ""]
    centre_gradient: Float[Array, " p"]
    value: Float[Array, "2 k"]
    ok: Bool[Array, "2 k"]
    gradient: Float[Array, "2 k p"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Estimate:
    """The estimated gradient of one start.

    Attributes:
        gradient: d value / du (p,); zero where no world counts.
        error: its standard error (p,); NaN from less than two pairs.
        first_order: share of the first order in it (p,).
        discarded: worlds that were left out.
        lost: whether no world was left to estimate from.
    """

    gradient: Float[Array, " p"]
    error: Float[Array, " p"]
    first_order: Float[Array, " p"]
    discarded: Int[Array, ""]
    lost: Bool[Array, ""]


class Estimator(Spec):
    """How the gradient of a start is estimated from its worlds; hashable, so that it is static in compiled programs.

    Attributes:
        samples: perturbed worlds of each start, an even number; 0 for `exact`.
        sigma: standard deviation of the perturbations, in coordinates u (`nermo_mjx.optimize.objective`).
        common: for which estimates the perturbations are the same: all `starts`, all `iterations`, `both`, or `none`.
        needs_gradient: whether the worlds' own gradients are wanted.
    """

    example = "{samples: 8, sigma: 0.1}"
    samples: int
    sigma: float
    common: str
    needs_gradient: ClassVar[bool] = True

    @property
    def name(self) -> str:
        """In a tuning file."""
        return type(self).__name__.lower()

    @property
    def worlds(self) -> int:
        """Worlds of each start."""
        return 1 + self.samples

    def estimate(self, worlds: Worlds) -> Estimate:
        """The gradient of one start."""
        raise NotImplementedError


@dataclasses.dataclass(frozen=True)
class Exact(Estimator):
    """The derivative at the point itself."""

    what = "an option of 'exact'"
    samples, sigma, common = 0, 0.0, "none"

    def estimate(self, worlds: Worlds) -> Estimate:
        lost = ~worlds.centre_ok
        error = jnp.full_like(worlds.centre_gradient, jnp.nan)
        return Estimate(worlds.centre_gradient, error, jnp.ones_like(error), lost.astype(int), lost)


@dataclasses.dataclass(frozen=True)
class Sampled(Estimator):
    """An estimator that perturbs."""

    what = "an option of an estimator with samples"
    samples: Annotated[int, Whole(2, 100_000, even=True)]
    """perturbed worlds of each start"""
    sigma: Positive
    """standard deviation of the perturbations, in coordinates u"""
    common: Annotated[str, Choice(COMMON)] = "none"
    """for which the perturbations are the same"""


@dataclasses.dataclass(frozen=True)
class Smoothed(Sampled):
    """First order: the mean of the derivatives at the perturbed points.

    Normalized, it is the mean of their directions, whose length of at most 1 says how far they agree. The derivative
    of a fast walk grows to 10,000 times its usual length at single points (two walks that part at a contact), and
    would be the mean by itself.
    """

    normalized: bool = False
    """whether each world's gradient counts with length 1"""

    def estimate(self, worlds: Worlds) -> Estimate:
        if self.normalized:
            length = jnp.linalg.norm(worlds.gradient, axis=-1, keepdims=True)
            worlds = dataclasses.replace(worlds, gradient=worlds.gradient / jnp.where(length > 0, length, 1.0))
        used, count = _usable(worlds)
        gradient, error = _mean(_first_order(worlds), used)
        return Estimate(gradient, error, jnp.ones_like(error), count, ~used.any())


@dataclasses.dataclass(frozen=True)
class Evolution(Sampled):
    """Zeroth order: from differences of values alone."""

    needs_gradient = False

    def estimate(self, worlds: Worlds) -> Estimate:
        used, count = _usable(worlds)
        gradient, error = _mean(_zeroth_order(self.sigma, worlds), used)
        return Estimate(gradient, error, jnp.zeros_like(error), count, ~used.any())


@dataclasses.dataclass(frozen=True)
class Mixture(Sampled):
    """Both orders, alpha * first + (1 - alpha) * zeroth, each parameter with its own alpha in [0, 1].

    With a and b the two orders' estimates from single pairs, s the sample covariances, n the number of pairs:

    1. Least variance: alpha = s(b, b - a) / (s(b - a, b - a) + extra), which is the ratio of inverse variances where
       the two are independent. They are not, because they share their perturbations.
    2. `extra` is variance that the first order has and does not show. A difference of two values is the mean of the
       derivative along the way between them, and means vary less than the derivative at the ends. Where they vary
       more, the objective jumps between the samples, and the excess is taken as the first order's variance.
    3. Bounded bias (Suh et al.: epsilon + alpha |bias| <= gamma): the bias is measured by the zeroth order of what the
       first leaves unexplained, B = mean of e (F+ - F- - 2 sigma e . first) / (2 sigma), which is far less noisy than
       the difference of the two; alpha |B| may be `gamma` standard errors of the zeroth order. So where the first
       order is wrong, it loses its weight as the samples grow.

    From less than two pairs nothing is known about variances, and alpha is 1/2.
    """

    samples: Annotated[int, Whole(4, 100_000, even=True)]
    """perturbed worlds of each start"""
    gamma: Positive = 1.0
    """most bias accepted from the first order, in standard errors of the zeroth"""

    def estimate(self, worlds: Worlds) -> Estimate:
        used, count = _usable(worlds)
        a, b = _first_order(worlds), _zeroth_order(self.sigma, worlds)
        (first, _), (zeroth, zeroth_error) = _mean(a, used), _mean(b, used)
        pairs = used.sum()

        unexplained = _half_difference(worlds) / self.sigma - worlds.noise @ first
        bias, _ = _mean(worlds.noise * unexplained[:, None], used)

        length = jnp.maximum(jnp.linalg.norm(worlds.noise, axis=-1), 1e-6)
        counted = worlds.ok & used
        varied = ((worlds.gradient - first) * worlds.noise).sum(axis=-1) / length
        shown = jnp.where(counted, varied**2, 0.0).sum() / jnp.maximum(counted.sum(), 1)
        seen = jnp.where(used, (unexplained / length) ** 2, 0.0).sum() / jnp.maximum(pairs, 1)
        extra = jnp.maximum(seen - shown, 0.0)

        gap = b - a
        least = _ratio(_covariance(b, gap, used), _covariance(gap, gap, used) + extra, otherwise=1.0)
        bounded = _ratio(self.gamma * zeroth_error, jnp.abs(bias), otherwise=1.0)
        alpha = jnp.where(pairs < 2, 0.5, jnp.clip(jnp.minimum(least, bounded), 0.0, 1.0))
        _, error = _mean(alpha * a + (1.0 - alpha) * b, used)
        return Estimate(alpha * first + (1.0 - alpha) * zeroth, error, alpha, count, ~used.any())


#: Estimators by their names in files.
ESTIMATORS: Final[Mapping[str, type[Estimator]]] = {
    "exact": Exact,
    "smoothed": Smoothed,
    "evolution": Evolution,
    "mixture": Mixture,
}


def perturbations(
    estimator: Estimator, key: UInt[Array, " 2"], iteration: Int[Array, ""], starts: int, parameters: int
) -> Float[Array, "starts k p"]:
    """The noise e of each start's k = samples / 2 pairs, a function of the key and the iteration's number alone."""
    base = jax.random.fold_in(
        jax.random.wrap_key_data(key), 0 if estimator.common in ("iterations", "both") else iteration
    )
    which = jnp.zeros(starts, int) if estimator.common in ("starts", "both") else jnp.arange(starts)
    keys = jax.vmap(lambda start: jax.random.fold_in(base, start))(which)
    return jax.vmap(lambda one: jax.random.normal(one, (estimator.samples // 2, parameters)))(keys)


def offsets(estimator: Estimator, noise: Float[Array, "*starts k p"]) -> Float[Array, "*starts worlds p"]:
    """Where each start's worlds stand relative to its point: the centre, the first halves, the second halves."""
    step = estimator.sigma * noise
    centre = jnp.zeros((*step.shape[:-2], 1, step.shape[-1]), step.dtype)
    return jnp.concatenate([centre, step, -step], axis=-2)


def estimate(
    estimator: Estimator,
    noise: Float[Array, "starts k p"],
    value: Float[Array, "starts worlds"],
    gradient: Float[Array, "starts worlds p"] | None,
    ok: Bool[Array, "starts worlds"],
) -> Estimate:
    """The gradient of each start (leading axis of every leaf) from all its worlds, ordered as `offsets` has them.

    Args:
        value: of the worlds; what is not `ok` may be anything.
        gradient: of the worlds to the coordinates u; None where the estimator does not need it.
    """
    starts, pairs, parameters = noise.shape
    if gradient is None:
        gradient = jnp.zeros((*value.shape, parameters), value.dtype)
    # What does not count is replaced before anything is computed from it, so that no NaN can come through a product.
    value, gradient = jnp.where(ok, value, 0.0), jnp.where(ok[..., None], gradient, 0.0)
    batch = Worlds(
        noise=noise,
        centre=value[:, 0],
        centre_ok=ok[:, 0],
        centre_gradient=gradient[:, 0],
        value=value[:, 1:].reshape(starts, 2, pairs),
        ok=ok[:, 1:].reshape(starts, 2, pairs),
        gradient=gradient[:, 1:].reshape(starts, 2, pairs, parameters),
    )
    return jax.vmap(estimator.estimate)(batch)


def _usable(worlds: Worlds) -> tuple[Bool[Array, " k"], Int[Array, ""]]:
    """Pairs that count, and the number of worlds (the centre included) that do not."""
    both, one = worlds.ok.all(axis=0), worlds.ok.any(axis=0)
    used = both | (one & worlds.centre_ok)
    return used, (~worlds.centre_ok).astype(int) + (~(worlds.ok & used)).sum()


def _half_difference(worlds: Worlds) -> Float[Array, " k"]:
    """(F+ - F-) / 2 of each pair; the difference from the centre where only one half counts."""
    stand_in = jnp.where(worlds.ok, worlds.value, worlds.centre)
    return (stand_in[0] - stand_in[1]) / jnp.maximum(worlds.ok.sum(axis=0), 1)


def _zeroth_order(sigma: float, worlds: Worlds) -> Float[Array, "k p"]:
    return worlds.noise * _half_difference(worlds)[:, None] / sigma


def _first_order(worlds: Worlds) -> Float[Array, "k p"]:
    return worlds.gradient.sum(axis=0) / jnp.maximum(worlds.ok.sum(axis=0), 1)[:, None]


def _mean(samples: Float[Array, "k p"], used: Bool[Array, " k"]) -> tuple[Float[Array, " p"], Float[Array, " p"]]:
    """Mean over the pairs that count (zero if none does) and its standard error (NaN from less than two)."""
    count = used.sum()
    mean = jnp.where(used[:, None], samples, 0.0).sum(axis=0) / jnp.maximum(count, 1)
    variance = _covariance(samples, samples, used)
    return mean, jnp.where(count > 1, jnp.sqrt(variance / jnp.maximum(count, 1)), jnp.nan)


def _covariance(x: Float[Array, "k p"], y: Float[Array, "k p"], used: Bool[Array, " k"]) -> Float[Array, " p"]:
    """Sample covariance over the pairs that count, of each parameter."""
    count, weight = used.sum(), used[:, None]
    centred = [each - jnp.where(weight, each, 0.0).sum(axis=0) / jnp.maximum(count, 1) for each in (x, y)]
    return jnp.where(weight, centred[0] * centred[1], 0.0).sum(axis=0) / jnp.maximum(count - 1, 1)


def _ratio(above: Float[Array, " p"], below: Float[Array, " p"], otherwise: float) -> Float[Array, " p"]:
    """A quotient, or `otherwise` where there is nothing to divide by."""
    return jnp.where(below > 0, above / jnp.where(below > 0, below, 1.0), otherwise)
