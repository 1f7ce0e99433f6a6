"""Identification of a robot from its logs, as `nermo-mjx identify --log` does; `nermo_mjx.identify.run` adds a directory.

The fit uses the first three quarters of each log; the rest, or other logs, validate it. It begins on a short piece of
the logs, with several starting points. The fitted model class is compared with the class without dispensable kinds of
parameters, and with classes that have one more kind.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Final

import numpy as np

from nermo_mjx.hardware.log import Log
from nermo_mjx.hardware.signals import channel_differences
from nermo_mjx.identify import determinacy
from nermo_mjx.identify.body import PARAMETER_KINDS, Body, load_body
from nermo_mjx.identify.determinacy import ResidualEvaluation, evaluate_residuals, percent
from nermo_mjx.identify.estimation import (
    INTERVAL_QUANTILES,
    Cache,
    Estimation,
    Fit,
    Parameter,
    ParameterSpace,
    compute_uncached,
    repeat_searches,
    rms,
)
from nermo_mjx.identify.twin import LoggedTwin, truncate_log
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import require

#: Share of a log that is fitted if no other log validates the result.
FITTED_SHARE: Final = 0.75
#: Minimum number of values of a channel in each part.
MIN_SAMPLES: Final = 5
#: Piece on which starting points are compared: share of a log, and minimum duration [s].
MIN_PIECE: Final = (0.2, 2.5)
#: Gauss-Newton starts at the default, then at the best points of a Sobol sequence, because a delay has local minima. For
#: a robot on the ground, whose contacts have many local minima, it also starts at the best points of CMA-ES. It stops if
#: the model explains the piece, or if two results are alike.
START_COUNT: Final = 3
SCANNED_POINTS: Final = 96
SEARCH_GENERATIONS: Final = 150
GENERATIONS_PER_START: Final = 25
#: Number of repeated searches for a robot on the ground: with contacts, other minima can be as deep as the true one.
SEARCH_REPEATS: Final = 6
#: Maximum number of Gauss-Newton steps.
GAUSS_NEWTON_STEPS: Final = 14
#: Two results are the same minimum if the mean logarithms of their residuals differ by less.
SAME_MINIMUM_TOLERANCE: Final = 1e-3
#: A smaller class is accepted if its error on validation samples exceeds the error of the larger class by less.
SIMPLEST_CLASS_TOLERANCE: Final = 0.02
#: A class is wrong if a missing kind of parameters would remove this share of the squared residuals.
MISSING_SHARE: Final = 0.1
#: Coordinate at which the effect of a missing kind is computed [standard deviations of the prior].
_TRIED_COORDINATE: Final = 0.5
#: Kinds that are estimated by default: all except the play of servos, which makes simulations slow.
FREE_KINDS: Final = tuple(kind for kind in PARAMETER_KINDS if kind not in ("dead_band", "backlash"))


@dataclasses.dataclass(frozen=True)
class BodyResidual:
    """The residuals of a parameter set.

    Attributes:
        twin: Predictions and samples.
        residual: Prediction minus measurement (n,), without the effects of unknown initial states.
        evaluation: Comparison of the residuals with noise.
    """

    twin: LoggedTwin
    residual: np.ndarray
    evaluation: ResidualEvaluation

    def error(self, sigma: np.ndarray) -> float:
        """Root mean square of the residuals, relative to the noise (channels,) of their channels."""
        return rms(self.residual / sigma[self.twin.measured.channel])


@dataclasses.dataclass(frozen=True)
class Identification:
    """The result of an identification.

    Attributes:
        body: Model with the parameters that were fitted.
        fit: Fit of the whole class.
        simplest: Fit of the simplest class within noise; `fit` if no class is simpler.
        left_out: Kinds that the simplest class omits.
        missing: Missing kind -> share of the squared residuals that it would remove.
        before, after: Residuals of the default and of the identified parameters on the validation samples.
        fitted: Residuals of the identified parameters on the fitted samples.
        errors: Name of a parameter set -> its error on the validation samples, relative to noise.
        repeatability: Channel -> difference of two logs with the same commands, relative to noise; empty without such
            logs.
        seconds: Wall time [s].
    """

    body: Body
    fit: Fit
    simplest: Fit
    left_out: tuple[str, ...]
    missing: Mapping[str, float]
    before: BodyResidual
    after: BodyResidual
    fitted: BodyResidual
    errors: Mapping[str, float]
    repeatability: Mapping[str, float]
    seconds: float

    @property
    def right(self) -> bool:
        """Whether the residuals of the class are noise."""
        return self.fitted.evaluation.right or (not self.missing and self.after.evaluation.right)

    @property
    def _simplest_columns(self) -> list[int]:
        """Indices of the parameters of the simplest class among all parameters."""
        names = [parameter.name for parameter in self.fit.space.parameters]
        return [names.index(parameter.name) for parameter in self.simplest.space.parameters]

    @property
    def values(self) -> np.ndarray:
        """Values (p,) of the class with the smaller error on the validation samples, because the whole class may overfit."""
        if self.simplest is self.fit or self.errors["simplest class"] > self.errors["identified"]:
            return self.fit.values
        values = np.array([parameter.absent for parameter in self.fit.space.parameters])
        values[self._simplest_columns] = self.simplest.values
        return values

    @property
    def bodies(self) -> np.ndarray:
        """Parameter values (n, p) sampled from the posterior, equally many from the whole and the simplest class."""
        full_bodies, simplest_bodies = self.fit.bodies, self.simplest.bodies
        simple = np.tile(
            [parameter.absent for parameter in self.fit.space.parameters], (len(simplest_bodies), 1)
        )
        simple[:, self._simplest_columns] = simplest_bodies
        parameter = min(len(full_bodies), len(simple))
        return (
            full_bodies
            if self.simplest is self.fit
            else np.concatenate([full_bodies[:parameter], simple[:parameter]])
        )

    @property
    def intervals(self) -> np.ndarray:
        """Ends (p, 2) of the 90 % intervals over both classes; a parameter of one class alone has the interval of this class."""
        sampled_values = self.fit.space.values(self.fit.draws)
        if self.simplest is not self.fit:
            half = len(sampled_values) // 2
            sampled_values[half:, self._simplest_columns] = self.simplest.space.values(
                self.simplest.draws
            )[half:]
        return np.quantile(sampled_values, INTERVAL_QUANTILES, axis=0).T

    # Long because each sentence of the report has its own condition.
    def sentences(self) -> list[str]:
        """The result in sentences."""
        sentences = list(self.body.notes)
        worst = int(np.argmax(self.fitted.evaluation.rms / self.fitted.evaluation.noise))
        label, judged = self.fitted.twin.labels[worst], self.fitted.evaluation
        if self.right:
            sentences.append("The model explains the log to its noise: what is left is white.")
        else:
            sentences.append(
                f"This class of models is wrong: residuals of {label} are "
                f"{judged.rms[worst] / judged.noise[worst]:.2g} times their noise and smooth "
                f"(von Neumann's ratio {judged.white[worst]:.2f}, of white noise 1)."
            )
            largest_gain = max(self.missing.values(), default=0.0)
            likely = sorted(
                (k for k, v in self.missing.items() if v > 0.8 * largest_gain),
                key=lambda k: -self.missing[k],
            )
            if largest_gain > MISSING_SHARE:
                removed = ", ".join(f"{kind} {percent(self.missing[kind])}" for kind in likely)
                sentences.append(
                    f"What was left out would remove these shares of their squares, each by itself: {removed}."
                )
            else:
                sentences.append("No kind of parameters that is known here removes them.")
            measured = self.after.twin.measured
            signal = measured.by_channel(
                lambda channel_values, i: float(np.std(channel_values)) or math.inf, measured.values
            )
            shares = [
                100 * channel_values.evaluation.rms / signal
                for channel_values in (self.after, self.before)
            ]
            best, default = (
                " to ".join(dict.fromkeys((f"{min(s):.3g}", f"{max(s):.3g}"))) for s in shares
            )
            sentences.append(
                f"On what was not fitted they are {best} % of the channels' signals, with the default body {default} %."
                " Intervals say how well the log fixes the best values in this class, not how true these are."
            )
        if len(self.fit.others):
            sentences.append(
                f"{len(self.fit.others) + 1} searches end at different bodies that explain the log as well: "
                "intervals are over all of them."
            )
        sentences += determinacy.describe_determinacy(self.fit)
        if self.left_out:
            sentences.append(
                f"The simplest class within noise leaves out {', '.join(self.left_out)}."
            )
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.errors.items())
        sentences.append(f"Error on what was not fitted, in noise: {errors}.")
        if (
            self.errors.get("simplest class", math.inf)
            < (1 - SIMPLEST_CLASS_TOLERANCE) * self.errors["identified"]
        ):
            sentences.append(
                "The whole class follows the noise of what was fitted: values are those of the simplest class."
            )
        if self.repeatability:
            repeatability_text = ", ".join(
                f"{name} {value:.3g}" for name, value in self.repeatability.items()
            )
            sentences.append(f"Two logs of one command differ by, in noise: {repeatability_text}.")
        return sentences


@dataclasses.dataclass(frozen=True)
class LogSplit:
    """The samples that are fitted, and the samples that validate the result.

    Attributes:
        fitted: Logs that are fitted.
        validation: Logs of the other samples.
        selection: Selection of samples of `validation`, see `LoggedTwin`.
    """

    fitted: Sequence[Log]
    validation: Sequence[Log]
    selection: Callable[[np.ndarray, float], np.ndarray] | None = None

    @classmethod
    def of(cls, logs: Sequence[Log], judges: Sequence[Log]) -> LogSplit:
        """Split the logs: all logs and the judges, or without judges the first part of each log and its rest."""
        if judges:
            return cls(logs, judges)
        heads = [truncate_log(log, FITTED_SHARE * log.duration) for log in logs]
        return cls(heads, logs, lambda times, duration: times >= FITTED_SHARE * duration)

    def check(self, body: Body, names: Sequence[str]) -> None:
        """Raise a `ParameterError` if a channel has too few samples in one of the parts."""
        twins = {
            "fitted": LoggedTwin(body, self.fitted, names),
            "not fitted": LoggedTwin(body, self.validation, names, self.selection),
        }
        for part, twin in twins.items():
            counts = np.bincount(twin.measured.channel, minlength=len(twin.labels)).tolist()
            if (least := min(counts)) < MIN_SAMPLES:
                which = f"channel {twin.labels[counts.index(least)]!r} has {least} numbers in what is {part}"
                raise ParameterError(
                    f"{which}: expected {MIN_SAMPLES} at least; leave it out, or give a longer log."
                )

    def residual(
        self, body: Body, names: Sequence[str], values: np.ndarray, sigma: np.ndarray
    ) -> BodyResidual:
        """The residual of a body with values (p,) of named parameters on the validation samples."""
        twin = LoggedTwin(body, self.validation, names, self.selection)
        twin.linearize(values)
        weights = sigma[twin.measured.channel]
        difference = twin.predict(values[None])[0] - twin.measured.values
        residual = twin.project((difference / weights)[:, None], sigma)[:, 0] * weights
        return BodyResidual(twin, residual, evaluate_residuals(twin.measured, residual))


def identify_log(
    logs: Sequence[Log],
    model: str | os.PathLike[str] = "nermo_lite",
    free: Sequence[str] = FREE_KINDS,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    judges: Sequence[Log] = (),
    seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
    cache: Cache = compute_uncached,
) -> Identification:
    """Fit the parameters of a model to logs, as `run_identification` does, without a directory.

    Args:
        logs: Logs to fit, see `read_log`.
        model: MJCF file, or `nermo_lite` or `nermo_41`.
        free: Kinds of parameters that are estimated.
        ranges: Name or kind of a parameter -> (low, high), the range of the search.
        judges: Logs that validate the result; by default the last quarter of each log does.
        seed: Seed of the starting points and samples.
        report: Function that receives the completed share.
        cache: Stores results of searches, see `Estimation`.

    Raises:
        ParameterError: The logs and the model do not fit together, no parameter is free, or cma is not installed.
    """
    require("identify", "cma", "cma")
    began = time.monotonic()
    unknown = [kind for kind in free if kind not in PARAMETER_KINDS and kind != "torque"]
    if unknown:
        raise ParameterError(
            f"{unknown[0]!r} is no kind of parameters: allowed is {', '.join(PARAMETER_KINDS)}."
        )
    make = functools.partial(load_body, model, [*logs, *judges])
    body = make(free)
    space = ParameterSpace(_narrow(list(body.parameters.values()), ranges or {}))
    if not len(space):
        raise ParameterError(f"the model has no parameter of {', '.join(free)}: nothing is free.")
    names, split = [parameter.name for parameter in space.parameters], LogSplit.of(logs, judges)
    split.check(body, names)
    fit, full_twin = _fit(body, space, split, seed, report, cache)
    evaluation = evaluate_residuals(full_twin.measured, fit.residual)
    fitted_residual = BodyResidual(full_twin, fit.residual, evaluation)
    held_out_after = split.residual(body, names, fit.values, fit.sigma)
    default = [
        parameter.neutral if math.isfinite(parameter.neutral) else parameter.low
        for parameter in space.parameters
    ]
    held_out_before = split.residual(body, names, np.array(default), fit.sigma)
    noise = held_out_after.evaluation.noise
    errors = {
        "default body": held_out_before.error(noise),
        "identified": held_out_after.error(noise),
    }
    left_out, simplest = tuple(determinacy.find_dispensable_kinds(fit)), fit
    if reduced := _fit_reduced(body, fit, left_out, split, seed, cache):
        candidate, error = reduced[0], reduced[1].error(noise)
        if error < (1 + SIMPLEST_CLASS_TOLERANCE) * errors["identified"]:
            simplest, errors["simplest class"] = candidate, error
    missing_kinds = {} if evaluation.right else _missing_gains(make, free, fit, full_twin)
    report(1.0)
    return Identification(
        body,
        fit,
        simplest,
        left_out if simplest is not fit else (),
        missing_kinds,
        held_out_before,
        held_out_after,
        fitted_residual,
        errors,
        _repeatability(logs, fit.sigma, full_twin.labels),
        time.monotonic() - began,
    )


def _fit(
    body: Body,
    space: ParameterSpace,
    split: LogSplit,
    seed: int,
    report: Callable[[float], None],
    cache: Cache,
) -> tuple[Fit, LoggedTwin]:
    """Fit the whole class on a piece of each log, longer pieces and whole logs; return the fit and the twin of the logs."""
    names, logs = [parameter.name for parameter in space.parameters], split.fitted
    # A piece of the logs suffices to compare starting points.
    pieces = [
        truncate_log(log, min(log.duration, max(MIN_PIECE[0] * log.duration, MIN_PIECE[1])))
        for log in logs
    ]
    longer = [
        truncate_log(log, 2 * piece.duration) for log, piece in zip(logs, pieces, strict=True)
    ]
    twins = [LoggedTwin(body, part, names) for part in (pieces, longer, logs)]
    stages = [Estimation(space, twin, cache) for twin in twins]
    starts, repeats = START_COUNT, 0
    if twins[0].has_free_base:
        starts, repeats = START_COUNT + SEARCH_GENERATIONS // GENERATIONS_PER_START, SEARCH_REPEATS
    total = starts + repeats + 3
    x, sigma = _find_start(
        stages[0], twins[0].has_free_base, seed, lambda done_count: report(done_count / total)
    )
    fit = repeat_searches(
        stages,
        x,
        sigma,
        GAUSS_NEWTON_STEPS,
        repeats,
        seed,
        lambda done_count: report((starts + 1 + done_count) / total),
    )
    report(1 - 2 / total)
    return fit, twins[-1]


def _find_start(
    piece: Estimation, has_free_base: bool, seed: int, report: Callable[[int], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Search from several starting points, and return the best coordinates (p,) and weights (channels,); see
    `START_COUNT`.

    Args:
        piece: Estimation on a piece of the logs.
        has_free_base: Whether the base of the robot is free.
        seed: Seed of the starting points.
        report: Function that receives the number of searches that are done.
    """

    def starts() -> Iterator[np.ndarray]:
        yield np.zeros(len(piece.space))
        yield from piece.scan(SCANNED_POINTS, seed)[: START_COUNT - 1]
        if has_free_base:
            yield from piece.search_globally(SEARCH_GENERATIONS, GENERATIONS_PER_START, seed)

    ends = list[tuple[np.ndarray, np.ndarray]]()
    for i, start in enumerate(starts()):
        ends.append(piece.search(start, iterations=GAUSS_NEWTON_STEPS, rounds=2))
        costs = [float(np.sum(np.log(sigma))) for _, sigma in ends]
        x, sigma = ends[int(np.argmin(costs))]
        report(i + 1)
        residual = piece.residual(x[:, None], sigma)[:, 0] * sigma[piece.measured.channel]
        alike = sum(cost < min(costs) + SAME_MINIMUM_TOLERANCE * len(sigma) for cost in costs) > 1
        if alike or evaluate_residuals(piece.measured, residual).right:
            break
    return x, sigma


def _fit_reduced(
    body: Body, fit: Fit, left_out: Sequence[str], split: LogSplit, seed: int, cache: Cache
) -> tuple[Fit, BodyResidual] | None:
    """Fit the class without some kinds, and compute its residual on the validation samples.

    Returns:
        None if no kind is omitted, or no parameter remains.
    """
    parameters = fit.space.parameters
    columns = [i for i, parameter in enumerate(parameters) if parameter.kind not in left_out]
    if not 0 < len(columns) < len(parameters):
        return None
    absent = {
        parameter.name: parameter.absent for parameter in parameters if parameter.kind in left_out
    }
    body, space = body.with_values(absent), ParameterSpace([parameters[i] for i in columns])
    names = [parameter.name for parameter in space.parameters]
    estimation = Estimation(space, LoggedTwin(body, split.fitted, names), cache)
    start, others = space.coordinates(fit.values[columns]), list(fit.others[:, columns])
    reduced = estimation.fit(start, fit.sigma, GAUSS_NEWTON_STEPS, 1, seed, others)
    return reduced, split.residual(body, names, reduced.values, fit.sigma)


def _narrow(
    parameters: list[Parameter], ranges: Mapping[str, tuple[float, float]]
) -> list[Parameter]:
    """Restrict parameters to ranges, by their names or kinds.

    Raises:
        ParameterError: A range does not belong to a parameter, or is empty.
    """
    for name, (low, high) in ranges.items():
        indices = [
            i for i, parameter in enumerate(parameters) if name in (parameter.name, parameter.kind)
        ]
        if not indices:
            raise ParameterError(f"--range names {name!r}, which is no free parameter.")
        if not -math.inf < low < high < math.inf:
            raise ParameterError(f"--range {name}: {low:g} to {high:g} is empty, or has no end.")
        for i in indices:
            parameter = parameters[i]
            if parameter.low > 0 >= low:
                raise ParameterError(
                    f"--range {name}: {low:g} to {high:g} is not above 0, as {parameter.name} is."
                )
            value = min(max(parameter.value, low), high)
            parameters[i] = dataclasses.replace(
                parameter, low=low, high=high, value=value, why="as given"
            )
    return parameters


def _missing_gains(
    make: Callable[[Sequence[str]], Body],
    free: Sequence[str],
    fit: Fit,
    full_twin: LoggedTwin,
) -> dict[str, float]:
    """Share of the squared residuals that each missing kind would remove, together with the free parameters."""
    others = tuple(kind for kind in (*PARAMETER_KINDS, "torque") if kind not in free)
    wider, gains = make((*free, *others)), dict[str, float]()
    names = [parameter.name for parameter in fit.space.parameters]
    full_twin.linearize(fit.values)
    white = Estimation(fit.space, full_twin).residual(fit.x[:, None], fit.sigma)[:, 0]
    for kind in others:
        added = [parameter for parameter in wider.parameters.values() if parameter.kind == kind]
        if not added:
            continue
        base = np.array(
            [
                parameter.neutral if math.isfinite(parameter.neutral) else parameter.value
                for parameter in added
            ]
        )
        space = ParameterSpace(added)
        start = np.clip(space.coordinates(base), space.low, space.high)
        step = np.where(
            start + _TRIED_COORDINATE > space.high, -_TRIED_COORDINATE, _TRIED_COORDINATE
        )
        values_moved = space.values(start + np.diag(step))
        rows = np.concatenate([np.tile(fit.values, (len(added), 1)), values_moved], axis=1)
        still = np.concatenate([fit.values, space.values(start)])[None]
        tried = LoggedTwin(
            wider, full_twin.logs, [*names, *(parameter.name for parameter in added)]
        )
        tried.linearize(still[0])
        change = (
            tried.predict(np.concatenate([still, rows])) / fit.sigma[tried.measured.channel]
        ).T
        change = tried.project(np.nan_to_num(change), fit.sigma)
        gains[kind] = determinacy.compute_gain(fit, (change[:, 1:] - change[:, :1]) / step, white)
    return gains


def _repeatability(
    logs: Sequence[Log], sigma: np.ndarray, labels: Sequence[str]
) -> dict[str, float]:
    """Differences of the robot between two logs with the same commands, relative to noise, by channel."""
    if len(logs) < 2:
        return {}
    differences = {
        difference.name: difference.rms / math.sqrt(2)
        for difference in channel_differences(*logs[:2])
    }
    commands = [
        differences[difference.name]
        for difference in logs[0].of_quantity("command").values()
        if difference.name in differences
    ]
    if not commands or max(commands) > 0.01:
        return {}
    axes = [
        [
            differences[n]
            for n in (label, *(f"{label} {axis}" for axis in "xyz"))
            if n in differences
        ]
        for label in labels
    ]
    return {
        label: rms(np.array(difference)) / sigma[i]
        for i, (label, difference) in enumerate(zip(labels, axes, strict=True))
        if difference
    }
