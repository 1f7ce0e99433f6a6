"""Estimation of named parameters from measured samples: values by Gauss-Newton, intervals, and determined directions.

A coordinate is the value of a parameter, or the logarithm of a positive parameter, minus its default, divided by the
standard deviation of a uniform distribution over the range. The prior is normal with this standard deviation, so that
the estimate stays at the default in directions that the data do not determine. Let J be the Jacobian of the whitened
residuals, with the singular values s. The standard deviation of the posterior along a singular direction, relative to
the prior, is 1 / sqrt(1 + s^2).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol, TypeAlias

import numpy as np
from mujoco import minimize
from scipy.stats import qmc

from nermo_mjx.optimize.search_methods import make_strategy

#: Returns the array that a function computes from an array of inputs, or the stored result of an earlier call.
Cache: TypeAlias = Callable[[Callable[[], np.ndarray], np.ndarray], np.ndarray]
#: A parameter is determined if its 90 % interval is narrower than this share of its range.
DETERMINED_SHARE: Final = 0.1
#: Number of samples of the posterior, and of replicates of the bootstrap.
POSTERIOR_SAMPLES: Final = 1000
#: Quantiles at the ends of a 90 % interval.
INTERVAL_QUANTILES: Final = (0.05, 0.95)
#: Number of points in a generation of CMA-ES.
POPULATION_SIZE: Final = 24
#: Minimum number of blocks of a bootstrap.
MIN_BLOCKS: Final = 10
#: Width of the one-sided differences in Gauss-Newton steps, and half-width of the central differences at the result
#: [standard deviations of the prior]. Both are wide enough for stepwise commands and for contacts.
DIFFERENCE_WIDTH: Final = 1e-4
CENTRAL_DIFFERENCE_WIDTH: Final = 1e-3
#: Parts of a model are independent if their parameters change the channels of other parts by less than this share.
INTERACTION_SHARE: Final = 1e-3
#: Standard deviation of the distance between the result and the starting points of repeated searches [standard
#: deviations of the prior].
RESTART_DISTANCE: Final = 0.3
#: A deviation is significant if it exceeds this number of standard deviations.
CHANCE_DEVIATIONS: Final = 4.0


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter that is estimated.

    Attributes:
        name, unit: Name and unit of the parameter.
        kind: Kind of the parameter. A model class contains all parameters of a kind, or none.
        value: Default, and centre of the prior.
        low, high: Range of the parameter. A positive range is logarithmic.
        why: Reason for the range.
        neutral: Value in a model class without this kind; NaN if there is no such value.
    """

    name: str
    kind: str
    unit: str
    value: float
    low: float
    high: float
    why: str
    neutral: float

    @property
    def absent(self) -> float:
        """Value within the range, for a model class without this kind."""
        return (
            min(max(self.neutral, self.low), self.high)
            if math.isfinite(self.neutral)
            else self.value
        )

    @property
    def logarithmic(self) -> bool:
        """Whether the coordinate is a logarithm."""
        return self.low > 0


class ParameterSpace:
    """Coordinates of parameters; see the module.

    Attributes:
        parameters: The parameters.
        log: Whether each coordinate is a logarithm (p,).
        width: Widths of the ranges, in logarithms for logarithmic coordinates (p,).
        deviation: Standard deviations of the prior, in the same unit (p,).
        low, high: Coordinates of the ends of the ranges (p,).
    """

    def __init__(self, parameters: Sequence[Parameter]) -> None:
        self.parameters = tuple(parameters)
        self.log = np.array([parameter.logarithmic for parameter in parameters], bool)
        self._centre = self._scaled(np.array([parameter.value for parameter in parameters], float))
        ends = [
            self._scaled(np.array([getattr(parameter, end) for parameter in parameters], float))
            for end in ("low", "high")
        ]
        self.width = ends[1] - ends[0]
        self.deviation = self.width / math.sqrt(12)
        self.low, self.high = [(end - self._centre) / self.deviation for end in ends]

    def __len__(self) -> int:
        return len(self.parameters)

    def _scaled(self, values: np.ndarray) -> np.ndarray:
        return np.where(self.log, np.log(np.where(self.log, values, 1.0)), values)

    def values(self, x: np.ndarray) -> np.ndarray:
        """Values of the parameters at coordinates (..., p)."""
        scaled = self._centre + np.clip(x, self.low, self.high) * self.deviation
        return np.where(self.log, np.exp(np.where(self.log, scaled, 0.0)), scaled)

    def coordinates(self, values: np.ndarray) -> np.ndarray:
        """Inverse of `values`."""
        return (self._scaled(np.asarray(values, float)) - self._centre) / self.deviation


@dataclasses.dataclass(frozen=True)
class LoggedSamples:
    """Measured values that a model predicts; the logs follow each other.

    Attributes:
        values: Values (n,), in the units of their channels.
        channel: Index of the channel of each value (n,).
        time: Time of each value (n,) [s]. It increases over all logs, so that a block of time belongs to one log.
        quantum: Resolution of each channel (channels,); 0 if it is fine.
    """

    values: np.ndarray
    channel: np.ndarray
    time: np.ndarray
    quantum: np.ndarray

    def by_channel(
        self, statistic: Callable[[np.ndarray, int], float], residual: np.ndarray
    ) -> np.ndarray:
        """Values (channels,) of a function of the residuals of a channel and its index."""
        return np.array(
            [statistic(residual[self.channel == i], i) for i in range(len(self.quantum))]
        )


def rms(residual: np.ndarray) -> float:
    """Root mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(residual**2))) if len(residual) else 0.0


def noise_floor(residual: np.ndarray, quantum: float = 0.0) -> float:
    """Root mean square of the white part of residuals.

    It is computed from differences of successive residuals, which smooth errors hardly affect (von Neumann, 1941).
    """
    return max(rms(np.diff(residual)) / math.sqrt(2), quantum / math.sqrt(12))


@dataclasses.dataclass(frozen=True)
class Fit:
    """The estimate of parameters.

    Attributes:
        space: Space of the parameters.
        x: Coordinates of the estimate (p,).
        residual: Prediction minus measurement (n,), without the part that `EstimationProblem.project` removes.
        sigma: Standard deviation of the residuals of each channel (channels,).
        jacobian: Derivatives of the whitened residuals with respect to the coordinates (n, p).
        share: Standard deviation of the posterior along each direction, relative to the prior (p,).
        directions: Orthonormal columns (p, p), the best determined direction first.
        draws: Samples of the posterior, as coordinates (samples, p).
        others: Coordinates (k, p) of other results that explain the data equally well; the posterior covers them.
    """

    space: ParameterSpace
    x: np.ndarray
    residual: np.ndarray
    sigma: np.ndarray
    jacobian: np.ndarray
    share: np.ndarray
    directions: np.ndarray
    draws: np.ndarray
    others: np.ndarray

    @property
    def values(self) -> np.ndarray:
        """Estimated values of the parameters (p,)."""
        return self.space.values(self.x)

    @property
    def bodies(self) -> np.ndarray:
        """Parameter values (n, p) of the posterior samples within the ranges.

        Samples outside are omitted, because clipping one parameter would change determined combinations.
        """
        free = [not is_bound for is_bound in self.at_bound]
        inside = ((self.draws >= self.space.low) & (self.draws <= self.space.high))[:, free].all(
            axis=1
        )
        return self.space.values(self.draws[inside] if inside.any() else self.draws)

    @property
    def intervals(self) -> np.ndarray:
        """Ends (p, 2) of the 90 % intervals of the values."""
        return self.space.values(np.quantile(self.draws, INTERVAL_QUANTILES, axis=0)).T

    @property
    def determined(self) -> np.ndarray:
        """Whether each parameter is determined (p,)."""
        low, high = np.quantile(self.draws, INTERVAL_QUANTILES, axis=0) * self.space.deviation
        return (high - low) < DETERMINED_SHARE * self.space.width

    @property
    def at_bound(self) -> list[str]:
        """Bound at which each parameter is: `lower`, `upper`, or an empty text."""
        near = 1e-3 * (self.space.high - self.space.low)
        low, high = self.x < self.space.low + near, self.x > self.space.high - near
        return [
            "lower" if is_low else "upper" if is_high else ""
            for is_low, is_high in zip(low, high, strict=True)
        ]


def compute_uncached(compute: Callable[[], np.ndarray], inputs: np.ndarray) -> np.ndarray:
    """Compute an array; a `Cache` without storage."""
    return compute()


class EstimationProblem(Protocol):
    """A model whose parameters an `Estimation` fits to measured samples.

    Attributes:
        measured: The samples.
        parts: Part of the model that contains each parameter (p,) and each channel (channels,); -1 is the whole model.
    """

    @property
    def measured(self) -> LoggedSamples: ...

    @property
    def parts(self) -> tuple[np.ndarray, np.ndarray]: ...

    def predict(self, values: np.ndarray) -> np.ndarray:
        """Predictions (k, n) of the samples for values (k, p); NaN where the model fails."""
        ...

    def linearize(self, values: np.ndarray) -> None:
        """Linearize the effects of unknown initial states at values (p,)."""
        ...

    def project(self, residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Whitened residuals (n, k) without the effects of unknown initial states, see `projection_without`."""
        ...


class Estimation:
    """Fits parameters to measured samples.

    Args:
        space: Space of the parameters.
        problem: The model and the samples.
        cache: Stores the results of searches. The searches of the same data have the same order and inputs.
    """

    def __init__(
        self, space: ParameterSpace, problem: EstimationProblem, cache: Cache = compute_uncached
    ) -> None:
        self.space, self.problem, self.measured = space, problem, problem.measured
        self._cache = cache

    def residual(self, x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Whitened residuals (n, k) at coordinates (p, k)."""
        difference = self.problem.predict(self.space.values(x.T)) - self.measured.values
        # The residuals of a failed model are large, but small enough for derivatives at nearby points.
        white = np.nan_to_num(
            difference / sigma[self.measured.channel], nan=1e3, posinf=1e3, neginf=-1e3
        )
        return self.problem.project(np.clip(white, -1e3, 1e3).T, sigma)

    def minimize(self, x: np.ndarray, sigma: np.ndarray, iterations: int) -> np.ndarray:
        """Minimize the sum of squares from a starting point (p,), and return the coordinates (p,).

        `mujoco.minimize` computes the steps, as in `mujoco.sysid`.
        """

        def posterior(x: np.ndarray) -> np.ndarray:
            return np.concatenate([self.residual(x, sigma), x])

        def slopes(x: np.ndarray, r: np.ndarray) -> np.ndarray:
            inward = np.where(
                x[:, 0] > (self.space.low + self.space.high) / 2,
                -DIFFERENCE_WIDTH,
                DIFFERENCE_WIDTH,
            )
            step = inward * np.maximum(1.0, np.abs(x[:, 0]))
            return np.concatenate(
                [self._changes(x[:, 0], sigma, step, r[: -len(x)]) / step, np.eye(len(x))]
            )

        def solve() -> np.ndarray:
            start, bounds = (
                np.clip(x, self.space.low, self.space.high),
                [self.space.low, self.space.high],
            )
            # The prior regularizes already: smaller values of mu change no step, and each trial needs simulations.
            least, _ = minimize.least_squares(
                start, posterior, bounds, slopes, mu_min=1.0, mu_factor=10.0, xtol=1e-4, max_iter=iterations,
                verbose=minimize.Verbosity.SILENT,
            )  # fmt: skip
            return np.asarray(least).ravel()

        return self._cache(solve, np.concatenate([x, sigma]))

    def _changes(
        self, x: np.ndarray, sigma: np.ndarray, step: np.ndarray, base_residual: np.ndarray
    ) -> np.ndarray:
        """Differences (n, p) of the residuals, with respect to the residuals (n, 1) at x (p,), for a step (p,) of each
        parameter alone, from one batch of simulations.

        Parameters of independent parts of the model share simulations.
        """
        part_of_parameter, part_of_channel = self.problem.parts
        if len(np.unique(part_of_channel)) > 1 and part_of_channel.min() >= 0:
            part_of_sample = part_of_channel[self.measured.channel][:, None]
            turn = np.array(
                [
                    np.sum(part_of_parameter[:i] == part) if part >= 0 else -1 - i
                    for i, part in enumerate(part_of_parameter)
                ]
            )
            turns, parts = np.unique(turn), np.unique(part_of_parameter[part_of_parameter >= 0])
            joint_steps = np.concatenate(
                [turn == turns[:, None], part_of_parameter == parts[:, None]]
            )
            differences = (
                self.residual(x[:, None] + step[:, None] * joint_steps.T, sigma) - base_residual
            )
            single_parts = np.abs(differences[:, len(turns) :])
            if (
                single_parts[part_of_sample != parts].max(initial=0.0)
                <= INTERACTION_SHARE * single_parts.max()
            ):  # the parts are independent
                return np.where(
                    (part_of_parameter < 0) | (part_of_sample == part_of_parameter),
                    differences[:, np.searchsorted(turns, turn)],
                    0.0,
                )
        return self.residual(x[:, None] + np.diag(step), sigma) - base_residual

    def initial_sigma(self) -> np.ndarray:
        """Initial standard deviations of the residuals (channels,): a tenth of the standard deviations of the channels."""
        values = self.measured.values
        wide = self.measured.by_channel(
            lambda channel_values, i: (
                0.1 * float(np.std(channel_values)) if len(channel_values) else 1.0
            ),
            values,
        )
        return np.maximum(wide, 1e-9)

    def scan(self, number: int, seed: int) -> np.ndarray:
        """Evaluate a Sobol sequence in the ranges, and return its coordinates (number, p), the best first."""
        space = self.space
        shares = qmc.Sobol(len(space), rng=seed).random_base2((number - 1).bit_length())[:number]
        points = space.low + shares * (space.high - space.low)
        return points[np.argsort(self.costs(points))]

    def costs(self, points: np.ndarray) -> np.ndarray:
        """Costs (k,) of coordinates (k, p): sums of the logarithms of the residuals of the channels.

        Their minimum does not depend on weights.
        """
        samples, floor = self.measured, self.initial_sigma() * 1e-6

        def compute() -> np.ndarray:
            difference = np.nan_to_num(
                self.problem.predict(self.space.values(points)) - samples.values, nan=1e6
            )
            return np.array(
                [
                    np.sum(
                        np.log(
                            floor
                            + samples.by_channel(
                                lambda channel_values, i: rms(channel_values), channel_values
                            )
                        )
                    )
                    for channel_values in difference
                ]
            )

        return self._cache(compute, points)

    def search_globally(self, generations: int, every: int, seed: int) -> Iterator[np.ndarray]:
        """Search the whole ranges by CMA-ES, which escapes local minima due to contacts.

        Args:
            generations: Maximum number of generations.
            every: Number of generations between two results.
            seed: Seed of the random numbers.

        Yields:
            The best coordinates (p,) so far.
        """
        low, wide = self.space.low, self.space.high - self.space.low
        middle, random = np.full(len(wide), 0.5), np.random.default_rng(seed)
        search = make_strategy(
            middle, 0.3, POPULATION_SIZE, random, bounds=[0.0, 1.0], maxiter=generations
        )
        while not search.stop():
            shares = search.ask()
            search.tell(shares, self.costs(low + np.array(shares) * wide).tolist())
            if search.countiter % every == 0:
                yield low + np.asarray(search.best.x) * wide

    def weights(self, x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Root mean square of the residuals of each channel (channels,), but at least its resolution."""
        difference = self.residual(x[:, None], sigma)[:, 0] * sigma[self.measured.channel]
        coarse = self.measured.quantum / math.sqrt(12)
        return np.maximum(
            self.measured.by_channel(lambda channel_values, i: rms(channel_values), difference),
            np.maximum(coarse, 1e-3 * self.initial_sigma()),
        )

    def search(
        self,
        start: np.ndarray,
        sigma: np.ndarray | None = None,
        iterations: int = 15,
        rounds: int = 3,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Search from a starting point, with the weights of the channels from their residuals.

        Args:
            start: Coordinates of the starting point (p,).
            sigma: Initial standard deviations of the residuals (channels,), by default `initial_sigma`.
            iterations: Maximum number of Gauss-Newton steps in each round.
            rounds: Maximum number of rounds; each one updates the weights.

        Returns:
            The coordinates (p,), and the standard deviations of the residuals (channels,).
        """
        x, sigma = start, self.initial_sigma() if sigma is None else sigma
        for _ in range(rounds):
            self.problem.linearize(self.space.values(x))
            before, x = sigma, self.minimize(x, sigma, iterations)
            sigma = self.weights(x, sigma)
            if np.all(np.abs(np.log(sigma / before)) < 0.02):
                break
        return x, sigma

    def fit(
        self,
        start: np.ndarray | None = None,
        sigma: np.ndarray | None = None,
        iterations: int = 15,
        rounds: int = 3,
        seed: int = 0,
        others: Sequence[np.ndarray] = (),
    ) -> Fit:
        """Estimate the parameters and their uncertainty; the arguments are described in `search` and `Fit`.

        If other results explain the data equally well, the true parameters are regarded as one more such result: the
        posterior has the mean and the covariance of all results, and the tails of Student's t.
        """
        x, sigma = self.search(
            np.zeros(len(self.space)) if start is None else start, sigma, iterations, rounds
        )
        jacobian, white = self.jacobian(x, sigma), self.residual(x[:, None], sigma)[:, 0]
        values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        share = self._shares(jacobian @ vectors, white, values, seed)
        random = np.random.default_rng(seed)
        draws = x + (random.standard_normal((POSTERIOR_SAMPLES, len(x))) * share) @ vectors.T
        if len(others):
            ends = np.stack([x, *others])
            free = len(others)
            tails = np.sqrt(free / random.chisquare(free, (POSTERIOR_SAMPLES, 1)))
            weights = (
                tails
                * random.standard_normal((POSTERIOR_SAMPLES, len(ends)))
                * math.sqrt((1 + 1 / len(ends)) / free)
            )
            centre = ends.mean(axis=0)
            draws = np.clip(
                draws - x + centre + weights @ (ends - centre), self.space.low, self.space.high
            )
            wide, vectors = np.linalg.eigh(np.cov(draws.T).reshape(len(x), -1))
            share = np.sqrt(np.maximum(wide, 0.0))
        residual = white * sigma[self.measured.channel]
        return Fit(
            self.space,
            x,
            residual,
            sigma,
            jacobian,
            share,
            vectors,
            draws,
            np.array(others).reshape(-1, len(x)),
        )

    def jacobian(self, x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Derivatives (n, p) of the whitened residuals, by central differences within the bounds."""
        up, down = (
            np.minimum(CENTRAL_DIFFERENCE_WIDTH, self.space.high - x),
            np.minimum(CENTRAL_DIFFERENCE_WIDTH, x - self.space.low),
        )
        before = self.residual(x[:, None], sigma)
        return (self._changes(x, sigma, up, before) - self._changes(x, sigma, -down, before)) / (
            up + down
        )

    def _shares(
        self, along: np.ndarray, white: np.ndarray, values: np.ndarray, seed: int
    ) -> np.ndarray:
        """Standard deviation of the posterior along each direction (p,).

        It is the larger one of two estimates: from white residuals, and from a bootstrap over blocks of time. With few
        blocks, the bootstrap alone would underestimate the uncertainty.
        """
        number = self.blocks(white)
        scores, precision = np.zeros((number.max() + 1, along.shape[1])), np.diag(values + 1.0)
        for block in range(len(scores)):
            # The score of a fit without this block (CR3), because a fit reduces the residuals of its own data.
            block_rows = along[number == block]
            scores[block] = precision @ np.linalg.solve(
                precision - block_rows.T @ block_rows, block_rows.T @ white[number == block]
            )
        scores -= scores.mean(axis=0)
        blocks = len(scores)
        random = np.random.default_rng((seed, 1))
        times = random.multinomial(blocks, np.full(blocks, 1 / blocks), POSTERIOR_SAMPLES)
        jackknife = (times - 1) @ scores * math.sqrt(blocks / max(blocks - 1, 1))
        bootstrap = jackknife.var(axis=0)
        small = 1.0 + 2.0 / max(blocks - 3, 1)  # variance of Student's t
        return np.sqrt(
            small * np.maximum(bootstrap, values) / (1.0 + values) ** 2 + 1.0 / (1.0 + values) ** 2
        )

    def blocks(self, white: np.ndarray) -> np.ndarray:
        """Index (n,) of the block of time of each residual; blocks are longer than the correlation of the residuals."""
        time, channel = self.measured.time, self.measured.channel
        span = float(np.ptp(time)) or 1.0
        memory = 0.0
        for i in range(len(self.measured.quantum)):
            channel_samples = white[channel == i]
            if len(channel_samples) > 8 and channel_samples.std() > 0:
                lags = min(len(channel_samples) // 4, 400)
                product = np.correlate(channel_samples, channel_samples, "full")[
                    len(channel_samples) - 1 :
                ][: lags + 1] / (channel_samples @ channel_samples)
                until = np.flatnonzero(product < 0.05)
                reach = until[0] if len(until) else lags
                step = float(np.median(np.diff(time[channel == i])))
                memory = max(memory, step * float(1 + 2 * product[1 : reach + 1].sum()))
        length = min(max(0.1, 4 * memory), span / MIN_BLOCKS)
        return np.minimum(((time - time.min()) / length).astype(int), math.ceil(span / length) - 1)


def repeat_searches(
    stages: Sequence[Estimation],
    x: np.ndarray,
    sigma: np.ndarray,
    steps: int,
    times: int,
    seed: int = 0,
    report: Callable[[int], None] = lambda done: None,
) -> Fit:
    """Estimate the parameters on longer and longer pieces of the data, and repeat the search near the result.

    The result is confirmed if repeated searches return to it. If they return different results that explain the data
    equally well, each one may be the true result, and the posterior covers all of them. A better result replaces the
    first one.

    Args:
        stages: Estimations on pieces of the data, each piece longer than the one before.
        x, sigma: Coordinates (p,) and standard deviations of the residuals (channels,) on the first piece.
        steps: Maximum number of Gauss-Newton steps in a round.
        times: Maximum number of repeated searches.
        seed: Seed of the starting points and samples.
        report: Function that receives the number of completed searches.
    """
    full_stage = stages[-1]
    for stage in stages[1:-1]:
        x, sigma = stage.search(x, sigma, steps, 2)
    fit = full_stage.fit(x, sigma, steps, seed=seed)
    random, ends, others, alike = (
        np.random.default_rng((seed, 2)),
        list[np.ndarray](),
        list[np.ndarray](),
        True,
    )

    def excess(estimation: Estimation, x: np.ndarray) -> float:
        """Excess of the squared residuals over those of the result, in standard deviations due to noise."""
        squares = np.sum(estimation.residual(np.stack([fit.x, x], axis=1), fit.sigma) ** 2, axis=0)
        return float((squares[1] / squares[0] - 1) * math.sqrt(len(estimation.measured.values) / 2))

    for k in range(times):
        report(k)
        end, weights = fit.x + RESTART_DISTANCE * random.standard_normal(len(fit.x)), None
        for stage in stages:
            end, weights = stage.search(end, weights, steps, 2)
            if excess(stage, end) > CHANCE_DEVIATIONS:
                break
        else:
            ends.append(end)
            if excess(full_stage, end) < 0:
                ends[-1], fit = fit.x, full_stage.fit(end, weights, rounds=0, seed=seed)
            others = [stage for stage in ends if excess(full_stage, stage) < CHANCE_DEVIATIONS]
            near = 3.29 * fit.draws.std(axis=0)  # their intervals of 90 % touch
            alike = all(np.all(np.abs(stage - fit.x) < near) for stage in others)
            if alike and len(others) > 1:
                break
    return fit if alike else full_stage.fit(fit.x, fit.sigma, rounds=0, seed=seed, others=others)


def projection_without(jacobian: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Projection of residuals (n, k) onto the complement of the columns of a Jacobian (n, m).

    It removes the effects of unknown initial states, to first order.
    """
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    basis = left[:, singular > 1e-9 * max(singular.max(initial=0.0), 1e-30)]
    return lambda residual: residual - basis @ (basis.T @ residual)
