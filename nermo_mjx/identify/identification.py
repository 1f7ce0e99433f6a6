"""Identification of a robot from its own logs: `nermo-mjx identify --log`, its directory and its report.

The first three quarters of each log are fitted, from the best of several starts on a short piece; the
rest, or another log, is the judge. Other classes are one without the kinds of parameters that the data do not ask for,
and those with one more kind.
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
from nermo_mjx.identify.body import PARAMETER_KINDS, Body, body_of
from nermo_mjx.identify.determinacy import Judgement, judge, percent
from nermo_mjx.identify.estimation import (
    ENDS,
    Cache,
    Estimation,
    Fit,
    Parameter,
    ParameterSpace,
    computed,
    repeated,
    rms,
)
from nermo_mjx.identify.twin import LoggedTwin, until
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.quantity import require

#: Share of a log that is fitted where no other log judges.
FITTED: Final = 0.75
#: Numbers of a channel that are needed in each of the parts.
MIN_SAMPLES: Final = 5
#: Piece on which starts are compared: share of a log, but no less than this [s].
PIECE: Final = (0.2, 2.5)
#: Gauss-Newton begins at the default, then at the best points of a Sobol sequence (a delay has local minima), then, of
#: a robot on the ground (contacts have many), at the best of so many generations of CMA-ES each time, until the piece
#: is explained, or two ends are alike.
STARTS: Final = 3
SCANNED: Final = 96
SEARCH_GENERATIONS: Final = 150
EVERY: Final = 25
#: The search of a robot on the ground is repeated so often: contacts give a log minima as deep as that of the truth.
SEARCH_REPEATS: Final = 6
#: Steps of Gauss-Newton, at most.
STEPS: Final = 14
#: Ends are one minimum if the mean logarithm of their channels' residuals differs by less.
ALIKE: Final = 1e-3
#: A class is within noise of a larger one if its error on seconds that were not fitted is larger by less.
WITHIN: Final = 0.02
#: A class that leaves out a kind which would remove this share of the residuals is wrong.
MISSING_SHARE: Final = 0.1
#: Coordinate that a kind which was left out is tried at [standard deviations of its prior].
_TRIED_COORDINATE: Final = 0.5
#: What is estimated by default: every kind but the play of servos, which makes simulations slow.
FREE: Final = tuple(kind for kind in PARAMETER_KINDS if kind not in ("dead_band", "backlash"))


@dataclasses.dataclass(frozen=True)
class BodyResidual:
    """A body beside samples.

    Attributes:
        twin: of the samples.
        residual: prediction minus measurement (n,), without what unknown starts explain.
        judgement: on them.
    """

    twin: LoggedTwin
    residual: np.ndarray
    judgement: Judgement

    def error(self, sigma: np.ndarray) -> float:
        """Root mean square over the channels in their noise."""
        return rms(self.residual / sigma[self.twin.measured.channel])


@dataclasses.dataclass(frozen=True)
class Identification:
    """The result.

    Attributes:
        body: that was fitted.
        fit: of the whole class.
        simplest: of the simplest class within noise; the whole class if none is simpler.
        left_out: kinds that it leaves out.
        missing: kind that was left out -> share of the squared residuals that it would remove.
        before, after, fitted: the default and the identified body on what was not fitted, and the latter on what was.
        errors: name of a body -> its error on what was not fitted [noise].
        repeatability: of two logs with one command, by channel; empty if there are none.
        seconds: wall time.
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
        """Whether the class explains the data to the noise."""
        return self.fitted.judgement.right or (not self.missing and self.after.judgement.right)

    @property
    def _own(self) -> list[int]:
        """Places of the simplest class's parameters among all."""
        names = [parameter.name for parameter in self.fit.space.parameters]
        return [names.index(parameter.name) for parameter in self.simplest.space.parameters]

    @property
    def values(self) -> np.ndarray:
        """Of the class that is nearer to what was not fitted (p,): the whole one may follow the noise of what was."""
        if self.simplest is self.fit or self.errors["simplest class"] > self.errors["identified"]:
            return self.fit.values
        values = np.array([parameter.absent for parameter in self.fit.space.parameters])
        values[self._own] = self.simplest.values
        return values

    @property
    def bodies(self) -> np.ndarray:
        """Values of bodies drawn from the posterior, as many of each of both classes (n, p)."""
        full_bodies, simplest_bodies = self.fit.bodies, self.simplest.bodies
        simple = np.tile(
            [parameter.absent for parameter in self.fit.space.parameters], (len(simplest_bodies), 1)
        )
        simple[:, self._own] = simplest_bodies
        parameter = min(len(full_bodies), len(simple))
        return (
            full_bodies
            if self.simplest is self.fit
            else np.concatenate([full_bodies[:parameter], simple[:parameter]])
        )

    @property
    def intervals(self) -> np.ndarray:
        """Ends of the 90 % intervals over both classes (p, 2); of what one leaves out, those of the other."""
        sampled_values = self.fit.space.values(self.fit.draws)
        if self.simplest is not self.fit:
            half = len(sampled_values) // 2
            sampled_values[half:, self._own] = self.simplest.space.values(self.simplest.draws)[
                half:
            ]
        return np.quantile(sampled_values, ENDS, axis=0).T

    # Long because each finding of the report is one statement.
    def sentences(self) -> list[str]:
        """The verdict in words."""
        sentences = list(self.body.notes)
        worst = int(np.argmax(self.fitted.judgement.rms / self.fitted.judgement.noise))
        label, judged = self.fitted.twin.labels[worst], self.fitted.judgement
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
                100 * channel_values.judgement.rms / signal
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
        sentences += determinacy.determinacy_sentences(self.fit)
        if self.left_out:
            sentences.append(
                f"The simplest class within noise leaves out {', '.join(self.left_out)}."
            )
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.errors.items())
        sentences.append(f"Error on what was not fitted, in noise: {errors}.")
        if self.errors.get("simplest class", math.inf) < (1 - WITHIN) * self.errors["identified"]:
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
        chosen: Which samples of `validation` count, see `LoggedTwin`.
    """

    fitted: Sequence[Log]
    validation: Sequence[Log]
    chosen: Callable[[np.ndarray, float], np.ndarray] | None = None

    @classmethod
    def of(cls, logs: Sequence[Log], judges: Sequence[Log]) -> LogSplit:
        """All logs and the judges, or without judges the first part of each log and the rest."""
        if judges:
            return cls(logs, judges)
        heads = [until(log, FITTED * log.duration) for log in logs]
        return cls(heads, logs, lambda times, duration: times >= FITTED * duration)

    def check(self, body: Body, names: Sequence[str]) -> None:
        """Raise a `ParameterError` if a channel has too few samples in one of the parts."""
        twins = {
            "fitted": LoggedTwin(body, self.fitted, names),
            "not fitted": LoggedTwin(body, self.validation, names, self.chosen),
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
        twin = LoggedTwin(body, self.validation, names, self.chosen)
        twin.renew(values)
        weights = sigma[twin.measured.channel]
        difference = twin.predict(values[None])[0] - twin.measured.values
        residual = twin.project((difference / weights)[:, None], sigma)[:, 0] * weights
        return BodyResidual(twin, residual, judge(twin.measured, residual))


def identify_log(
    logs: Sequence[Log],
    model: str | os.PathLike[str] = "nermo_lite",
    free: Sequence[str] = FREE,
    ranges: Mapping[str, tuple[float, float]] | None = None,
    judges: Sequence[Log] = (),
    seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
    cache: Cache = computed,
) -> Identification:
    """Fit a body to logs, as `run_identification` does, without a directory.

    Args:
        logs: to fit, see `read_log`.
        model: MJCF file, or `nermo_lite` or `nermo_41`.
        free: kinds of parameters that are estimated.
        ranges: name or kind of a parameter -> (low, high), inside which it is searched.
        judges: other logs that judge; by default the last quarter of each.
        seed: of starts and draws.
        report: is told the share done.
        cache: Stores results of searches, see `Estimation`.

    Raises:
        ParameterError: the log and the model do not fit together, no parameter is free, or cma is not installed.
    """
    require("identify", "cma", "cma")
    began = time.monotonic()
    unknown = [kind for kind in free if kind not in PARAMETER_KINDS and kind != "torque"]
    if unknown:
        raise ParameterError(
            f"{unknown[0]!r} is no kind of parameters: allowed is {', '.join(PARAMETER_KINDS)}."
        )
    make = functools.partial(body_of, model, [*logs, *judges])
    body = make(free)
    space = ParameterSpace(_narrowed(list(body.parameters.values()), ranges or {}))
    if not len(space):
        raise ParameterError(f"the model has no parameter of {', '.join(free)}: nothing is free.")
    names, split = [parameter.name for parameter in space.parameters], LogSplit.of(logs, judges)
    split.check(body, names)
    fit, full_twin = _fit(body, space, split, seed, report, cache)
    fitted_residual = BodyResidual(full_twin, fit.residual, judge(full_twin.measured, fit.residual))
    held_out_after = split.residual(body, names, fit.values, fit.sigma)
    default = [
        parameter.neutral if math.isfinite(parameter.neutral) else parameter.low
        for parameter in space.parameters
    ]
    held_out_before = split.residual(body, names, np.array(default), fit.sigma)
    noise = held_out_after.judgement.noise
    errors = {
        "default body": held_out_before.error(noise),
        "identified": held_out_after.error(noise),
    }
    left_out, simplest = tuple(determinacy.dispensable(fit)), fit
    if reduced := _reduced(body, fit, left_out, split, seed, cache):
        candidate, error = reduced[0], reduced[1].error(noise)
        if error < (1 + WITHIN) * errors["identified"]:
            simplest, errors["simplest class"] = candidate, error
    missing_kinds = {} if fitted_residual.judgement.right else _missing(make, free, fit, full_twin)
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
    """The fit of the whole class, from a piece of each log to longer pieces and whole logs, and the twin of these."""
    names, logs = [parameter.name for parameter in space.parameters], split.fitted
    # Starts are compared on a piece, where wrong ones are told from right ones as well.
    pieces = [until(log, min(log.duration, max(PIECE[0] * log.duration, PIECE[1]))) for log in logs]
    longer = [until(log, 2 * piece.duration) for log, piece in zip(logs, pieces, strict=True)]
    twins = [LoggedTwin(body, part, names) for part in (pieces, longer, logs)]
    stages = [Estimation(space, twin, cache) for twin in twins]
    starts, repeats = STARTS, 0
    if twins[0].stands:
        starts, repeats = STARTS + SEARCH_GENERATIONS // EVERY, SEARCH_REPEATS
    total = starts + repeats + 3
    x, sigma = _start(
        stages[0], twins[0].stands, seed, lambda done_count: report(done_count / total)
    )
    fit = repeated(
        stages,
        x,
        sigma,
        STEPS,
        repeats,
        seed,
        lambda done_count: report((starts + 1 + done_count) / total),
    )
    report(1 - 2 / total)
    return fit, twins[-1]


def _start(
    piece: Estimation, stands: bool, seed: int, report: Callable[[int], None]
) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates (p,) and weights (channels,) of the best of several searches, see `STARTS`.

    Args:
        piece: Estimation on a piece of the logs.
        stands: Whether the base of the robot is free.
        seed: Seed of the starting points.
        report: Function that receives the number of searches that are done.
    """

    def starts() -> Iterator[np.ndarray]:
        yield np.zeros(len(piece.space))
        yield from piece.scanned(SCANNED, seed)[: STARTS - 1]
        if stands:
            yield from piece.sought(SEARCH_GENERATIONS, EVERY, seed)

    ends = list[tuple[np.ndarray, np.ndarray]]()
    for i, start in enumerate(starts()):
        ends.append(piece.search(start, iterations=STEPS, rounds=2))
        costs = [float(np.sum(np.log(sigma))) for _, sigma in ends]
        x, sigma = ends[int(np.argmin(costs))]
        report(i + 1)
        residual = piece.residual(x[:, None], sigma)[:, 0] * sigma[piece.measured.channel]
        alike = sum(cost < min(costs) + ALIKE * len(sigma) for cost in costs) > 1
        if alike or judge(piece.measured, residual).right:
            break
    return x, sigma


def _reduced(
    body: Body, fit: Fit, left_out: Sequence[str], split: LogSplit, seed: int, cache: Cache
) -> tuple[Fit, BodyResidual] | None:
    """The fit of the class without some kinds, and its residual on the validation samples; None if there is none."""
    parameters = fit.space.parameters
    columns = [i for i, parameter in enumerate(parameters) if parameter.kind not in left_out]
    if not 0 < len(columns) < len(parameters):
        return None
    absent = {
        parameter.name: parameter.absent for parameter in parameters if parameter.kind in left_out
    }
    body, space = body.at(absent), ParameterSpace([parameters[i] for i in columns])
    names = [parameter.name for parameter in space.parameters]
    estimation = Estimation(space, LoggedTwin(body, split.fitted, names), cache)
    start, others = space.coordinates(fit.values[columns]), list(fit.others[:, columns])
    reduced = estimation.fit(start, fit.sigma, STEPS, 1, seed, others)
    return reduced, split.residual(body, names, reduced.values, fit.sigma)


def _narrowed(
    parameters: list[Parameter], ranges: Mapping[str, tuple[float, float]]
) -> list[Parameter]:
    """Parameters inside the ranges that were given.

    Raises:
        ParameterError: a range of no parameter, or an empty one.
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


def _missing(
    make: Callable[[Sequence[str]], Body],
    free: Sequence[str],
    fit: Fit,
    full_twin: LoggedTwin,
) -> dict[str, float]:
    """Share of the squared residuals that each kind that was left out would remove, together with all that is free."""
    others = tuple(kind for kind in (*PARAMETER_KINDS, "torque") if kind not in free)
    wider, gains = make((*free, *others)), dict[str, float]()
    names = [parameter.name for parameter in fit.space.parameters]
    full_twin.renew(fit.values)
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
        tried.renew(still[0])
        change = (
            tried.predict(np.concatenate([still, rows])) / fit.sigma[tried.measured.channel]
        ).T
        change = tried.project(np.nan_to_num(change), fit.sigma)
        gains[kind] = determinacy.gain_of(fit, (change[:, 1:] - change[:, :1]) / step, white)
    return gains


def _repeatability(
    logs: Sequence[Log], sigma: np.ndarray, labels: Sequence[str]
) -> dict[str, float]:
    """How much the robot itself differs between two logs of one command, by channel [noise]."""
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
