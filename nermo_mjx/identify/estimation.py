"""What data determine of named parameters: values by Gauss-Newton, intervals, and determined directions in words.

Coordinates are logarithms of positive parameters and values of others, over the standard deviation of a uniform
distribution over the range; 0 is the default. The prior is normal with that deviation, so directions that the data do
not determine stay at the default. With the Jacobian J of the whitened residuals, a direction's share of the prior's
width is 1 / sqrt(1 + s^2), with the singular values s of J.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Final, Protocol, TypeAlias

import numpy as np
from mujoco import minimize
from scipy.stats import qmc

from nermo_mjx.optimize.search_methods import strategy

#: Returns the array that a function computes from an array of inputs, computed now or stored before.
Cache: TypeAlias = Callable[[Callable[[], np.ndarray], np.ndarray], np.ndarray]
#: A parameter is determined if its 90 % interval is narrower than this share of its range.
DETERMINED: Final = 0.1
#: Draws of the posterior, and replicates of the bootstrap.
DRAWS: Final = 1000
#: Ends of a 90 % interval.
ENDS: Final = (0.05, 0.95)
#: Points of a generation of CMA-ES.
POPULATION: Final = 24
#: Fewest blocks of a bootstrap.
BLOCKS: Final = 10
#: Width of the differences in Gauss-Newton steps, and half-width of those at the result [standard deviations of the
#: prior]: wide enough for commands that are held and for contacts.
DIFFERENCE_WIDTH: Final = 1e-4
CENTRAL: Final = 1e-3
#: Parts of a model whose parameters change each other's channels by less, as a share, do not act on each other.
ACTS: Final = 1e-3
#: Distance from the result at which searches begin again [standard deviations of the prior].
BESIDE: Final = 0.3
#: A deviation of more standard deviations than this is not chance.
CHANCE: Final = 4.0


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter that is estimated.

    Attributes:
        name, unit: what it is called, and its unit.
        kind: those of one kind are one part of a model class.
        value: default, and centre of the prior.
        low, high: its range; positive ranges are logarithmic.
        why: reason for the range.
        neutral: value of a model class without this kind.
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
        """Its value where its kind is left out, in the range."""
        return (
            min(max(self.neutral, self.low), self.high)
            if math.isfinite(self.neutral)
            else self.value
        )

    @property
    def logarithmic(self) -> bool:
        """Whether its coordinate is a logarithm."""
        return self.low > 0


class ParameterSpace:
    """Coordinates of parameters."""

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
    """Numbers that a model predicts, of all logs one after the other.

    Attributes:
        values: (n,), in the units of their channels.
        channel: index of each one's channel (n,).
        time: of each [s], growing over all logs, so that a block of time is a part of one log.
        quantum: smallest step of each channel's values; 0 if they are fine.
    """

    values: np.ndarray
    channel: np.ndarray
    time: np.ndarray
    quantum: np.ndarray

    def by_channel(
        self, statistic: Callable[[np.ndarray, int], float], residual: np.ndarray
    ) -> np.ndarray:
        """A number for each channel from its residuals and its index (channels,)."""
        return np.array(
            [statistic(residual[self.channel == i], i) for i in range(len(self.quantum))]
        )


def rms(residual: np.ndarray) -> float:
    """Root mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(residual**2))) if len(residual) else 0.0


def floor(residual: np.ndarray, quantum: float = 0.0) -> float:
    """The white part of residuals: from their changes, which smooth errors hardly have (von Neumann, 1941)."""
    return max(rms(np.diff(residual)) / math.sqrt(2), quantum / math.sqrt(12))


@dataclasses.dataclass(frozen=True)
class Fit:
    """The estimate.

    Attributes:
        space: of the parameters.
        x: their coordinates (p,).
        residual: prediction minus measurement (n,), without what `project` removes.
        sigma: standard deviation of each channel's residuals (channels,).
        jacobian: of the whitened residuals to the coordinates (n, p).
        share: standard deviation of the posterior along each of the directions, as a share of the prior's (p,).
        directions: orthonormal columns (p, p), the best determined one first.
        draws: of the posterior (draws, p), in coordinates.
        others: coordinates of other ends that explain the data as well, which the posterior is over (k, p).
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
        """Of the parameters (p,)."""
        return self.space.values(self.x)

    @property
    def bodies(self) -> np.ndarray:
        """Values of the draws inside the ranges (n, p): cut at an end, one would lose what is determined together."""
        free = [not is_bound for is_bound in self.at_bound]
        inside = ((self.draws >= self.space.low) & (self.draws <= self.space.high))[:, free].all(
            axis=1
        )
        return self.space.values(self.draws[inside] if inside.any() else self.draws)

    @property
    def intervals(self) -> np.ndarray:
        """Ends of the 90 % intervals of the values (p, 2)."""
        return self.space.values(np.quantile(self.draws, ENDS, axis=0)).T

    @property
    def determined(self) -> np.ndarray:
        """Whether each parameter is (p,)."""
        low, high = np.quantile(self.draws, ENDS, axis=0) * self.space.deviation
        return (high - low) < DETERMINED * self.space.width

    @property
    def at_bound(self) -> list[str]:
        """`lower`, `upper` or nothing for each parameter."""
        near = 1e-3 * (self.space.high - self.space.low)
        low, high = self.x < self.space.low + near, self.x > self.space.high - near
        return [
            "lower" if is_low else "upper" if is_high else ""
            for is_low, is_high in zip(low, high, strict=True)
        ]


def computed(compute: Callable[[], np.ndarray], inputs: np.ndarray) -> np.ndarray:
    """The `Cache` that stores nothing."""
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

    def renew(self, values: np.ndarray) -> None:
        """Linearize the effects of unknown initial states at values (p,)."""
        ...

    def project(self, residual: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Whitened residuals (n, k) without the effects of unknown initial states, see `without`."""
        ...


class Estimation:
    """Fits parameters to measured numbers.

    Args:
        space: of the parameters.
        problem: The model and the samples.
        cache: Stores the results of searches. The searches of the same data have the same order and inputs.
    """

    def __init__(
        self, space: ParameterSpace, problem: EstimationProblem, cache: Cache = computed
    ) -> None:
        self.space, self.problem, self.measured = space, problem, problem.measured
        self._cache = cache

    def residual(self, x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Whitened residuals (n, k) at coordinates (p, k)."""
        difference = self.problem.predict(self.space.values(x.T)) - self.measured.values
        # A model that fails is far away, but not so far that the derivatives beside it are lost.
        white = np.nan_to_num(
            difference / sigma[self.measured.channel], nan=1e3, posinf=1e3, neginf=-1e3
        )
        return self.problem.project(np.clip(white, -1e3, 1e3).T, sigma)

    def minimum(self, x: np.ndarray, sigma: np.ndarray, iterations: int) -> np.ndarray:
        """Coordinates (p,) of the least squares from a start, by `mujoco.minimize`, as `mujoco.sysid` does."""

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

        def found() -> np.ndarray:
            start, bounds = (
                np.clip(x, self.space.low, self.space.high),
                [self.space.low, self.space.high],
            )
            # Less regularization than the prior's own changes no step, and each try is a simulation.
            least, _ = minimize.least_squares(
                start, posterior, bounds, slopes, mu_min=1.0, mu_factor=10.0, xtol=1e-4, max_iter=iterations,
                verbose=minimize.Verbosity.SILENT,
            )  # fmt: skip
            return np.asarray(least).ravel()

        return self._cache(found, np.concatenate([x, sigma]))

    def _changes(
        self, x: np.ndarray, sigma: np.ndarray, step: np.ndarray, base_residual: np.ndarray
    ) -> np.ndarray:
        """Of the residuals (n, 1) at x (p,), by a step (p,) of each parameter alone (n, p), in one batch.

        Parameters of parts of the model that do not act on each other share simulations.
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
                single_parts[part_of_sample != parts].max(initial=0.0) <= ACTS * single_parts.max()
            ):  # they do not touch each other
                return np.where(
                    (part_of_parameter < 0) | (part_of_sample == part_of_parameter),
                    differences[:, np.searchsorted(turns, turn)],
                    0.0,
                )
        return self.residual(x[:, None] + np.diag(step), sigma) - base_residual

    def spread(self) -> np.ndarray:
        """Of each channel, a start for the weights: a tenth of its standard deviation (channels,)."""
        values = self.measured.values
        wide = self.measured.by_channel(
            lambda channel_values, i: (
                0.1 * float(np.std(channel_values)) if len(channel_values) else 1.0
            ),
            values,
        )
        return np.maximum(wide, 1e-9)

    def scanned(self, number: int, seed: int) -> np.ndarray:
        """Coordinates (number, p) of a Sobol sequence in the ranges, the best first."""
        space = self.space
        shares = qmc.Sobol(len(space), rng=seed).random_base2((number - 1).bit_length())[:number]
        points = space.low + shares * (space.high - space.low)
        return points[np.argsort(self.costs(points))]

    def costs(self, points: np.ndarray) -> np.ndarray:
        """Of coordinates (k, p): the sum of the logarithms of the channels' residuals, whose least needs no weights."""
        samples, floor = self.measured, self.spread() * 1e-6

        def found() -> np.ndarray:
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

        return self._cache(found, points)

    def sought(self, generations: int, every: int, seed: int) -> Iterator[np.ndarray]:
        """Best coordinates (p,) so far of CMA-ES over the whole ranges, which local minima of contacts do not stop.

        Args:
            generations: at most.
            every: how many come before each of what is found.
            seed: of the draws.
        """
        low, wide = self.space.low, self.space.high - self.space.low
        middle, random = np.full(len(wide), 0.5), np.random.default_rng(seed)
        search = strategy(middle, 0.3, POPULATION, random, bounds=[0.0, 1.0], maxiter=generations)
        while not search.stop():
            shares = search.ask()
            search.tell(shares, self.costs(low + np.array(shares) * wide).tolist())
            if search.countiter % every == 0:
                yield low + np.asarray(search.best.x) * wide

    def weights(self, x: np.ndarray, sigma: np.ndarray) -> np.ndarray:
        """Each channel's residuals, but no less than what its values can tell (channels,)."""
        difference = self.residual(x[:, None], sigma)[:, 0] * sigma[self.measured.channel]
        coarse = self.measured.quantum / math.sqrt(12)
        return np.maximum(
            self.measured.by_channel(lambda channel_values, i: rms(channel_values), difference),
            np.maximum(coarse, 1e-3 * self.spread()),
        )

    def search(
        self,
        start: np.ndarray,
        sigma: np.ndarray | None = None,
        iterations: int = 15,
        rounds: int = 3,
    ) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (p,) and weights (channels,) from a start, with each channel weighted by its own residuals.

        Args:
            start: coordinates (p,).
            sigma: first weights (channels,).
            iterations: of Gauss-Newton, at most, in each of the rounds; weights are renewed after each.
        """
        x, sigma = start, self.spread() if sigma is None else sigma
        for _ in range(rounds):
            self.problem.renew(self.space.values(x))
            before, x = sigma, self.minimum(x, sigma, iterations)
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
        """The estimate from a start, by default the defaults, with its uncertainty; see `search` and `Fit`.

        Where other ends explain the data as well, the parameters are taken for one more such end: those of the
        posterior have the mean of all, their covariance, and the tails of Student's t.
        """
        x, sigma = self.search(
            np.zeros(len(self.space)) if start is None else start, sigma, iterations, rounds
        )
        jacobian, white = self.jacobian(x, sigma), self.residual(x[:, None], sigma)[:, 0]
        values, vectors = np.linalg.eigh(jacobian.T @ jacobian)
        values, vectors = np.maximum(values[::-1], 0.0), vectors[:, ::-1]
        share = self._shares(jacobian @ vectors, white, values, seed)
        random = np.random.default_rng(seed)
        draws = x + (random.standard_normal((DRAWS, len(x))) * share) @ vectors.T
        if len(others):
            ends = np.stack([x, *others])
            free = len(others)
            tails = np.sqrt(free / random.chisquare(free, (DRAWS, 1)))
            weights = (
                tails
                * random.standard_normal((DRAWS, len(ends)))
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
        """Of the whitened residuals (n, p), by central differences within the bounds."""
        up, down = np.minimum(CENTRAL, self.space.high - x), np.minimum(CENTRAL, x - self.space.low)
        before = self.residual(x[:, None], sigma)
        return (self._changes(x, sigma, up, before) - self._changes(x, sigma, -down, before)) / (
            up + down
        )

    def _shares(
        self, along: np.ndarray, white: np.ndarray, values: np.ndarray, seed: int
    ) -> np.ndarray:
        """Standard deviation of the posterior along each direction (p,).

        The white residuals' one and that of a bootstrap over blocks of time are compared, and the larger taken: with
        few blocks the bootstrap alone would call what it cannot see certain.
        """
        number = self.blocks(white)
        scores, precision = np.zeros((number.max() + 1, along.shape[1])), np.diag(values + 1.0)
        for block in range(len(scores)):
            # Of a fit without this block: what it has fitted itself does not tell how much it scatters (CR3).
            block_rows = along[number == block]
            scores[block] = precision @ np.linalg.solve(
                precision - block_rows.T @ block_rows, block_rows.T @ white[number == block]
            )
        scores -= scores.mean(axis=0)
        blocks = len(scores)
        random = np.random.default_rng((seed, 1))
        times = random.multinomial(blocks, np.full(blocks, 1 / blocks), DRAWS)
        jackknife = (times - 1) @ scores * math.sqrt(blocks / max(blocks - 1, 1))
        bootstrap = jackknife.var(axis=0)
        small = 1.0 + 2.0 / max(blocks - 3, 1)  # variance of Student's t
        return np.sqrt(
            small * np.maximum(bootstrap, values) / (1.0 + values) ** 2 + 1.0 / (1.0 + values) ** 2
        )

    def blocks(self, white: np.ndarray) -> np.ndarray:
        """Number of the block of time that each residual is in (n,): blocks are long against their correlation."""
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
        length = min(max(0.1, 4 * memory), span / BLOCKS)
        return np.minimum(((time - time.min()) / length).astype(int), math.ceil(span / length) - 1)


def repeated(
    stages: Sequence[Estimation],
    x: np.ndarray,
    sigma: np.ndarray,
    steps: int,
    times: int,
    seed: int = 0,
    report: Callable[[int], None] = lambda done: None,
) -> Fit:
    """The estimate from a start on a piece of the data, on longer pieces, and again from beside the result.

    Searches that end at the result again show that it is the minimum. If others explain the data as well, each of
    their ends may be the truth, and the posterior is over all of them. A better end becomes the result.

    Args:
        stages: of pieces, each longer than the one before.
        x, sigma: coordinates (p,) and weights (channels,) on the first piece.
        steps: of Gauss-Newton, at most.
        times: that the search is repeated, at most.
        seed: of the starts and of draws.
        report: is told how many searches are done.
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
        """How much worse a body explains a piece than the result, in standard deviations of what noise would do."""
        squares = np.sum(estimation.residual(np.stack([fit.x, x], axis=1), fit.sigma) ** 2, axis=0)
        return float((squares[1] / squares[0] - 1) * math.sqrt(len(estimation.measured.values) / 2))

    for k in range(times):
        report(k)
        end, weights = fit.x + BESIDE * random.standard_normal(len(fit.x)), None
        for stage in stages:
            end, weights = stage.search(end, weights, steps, 2)
            if excess(stage, end) > CHANCE:
                break
        else:
            ends.append(end)
            if excess(full_stage, end) < 0:
                ends[-1], fit = fit.x, full_stage.fit(end, weights, rounds=0, seed=seed)
            others = [stage for stage in ends if excess(full_stage, stage) < CHANCE]
            near = 3.29 * fit.draws.std(axis=0)  # their intervals of 90 % touch
            alike = all(np.all(np.abs(stage - fit.x) < near) for stage in others)
            if alike and len(others) > 1:
                break
    return fit if alike else full_stage.fit(fit.x, fit.sigma, rounds=0, seed=seed, others=others)


def without(jacobian: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """What removes from residuals (n, k) all that a linear change of unknown starts explains, jacobian (n, m)."""
    left, singular, _ = np.linalg.svd(jacobian, full_matrices=False)
    basis = left[:, singular > 1e-9 * max(singular.max(initial=0.0), 1e-30)]
    return lambda residual: residual - basis @ (basis.T @ residual)
