"""Where a metric is best: for each group the best point, the points that cannot be told from it, and what it gains.

The first runs of all points choose, and those of a second stage, which goes on where the best may be. Fresh runs of the
best point and of its base measure the gain: they chose nothing, so that no luck of the choice is in it. All of them are
rows of the sweep's table, and what is still to be run follows from the table alone; docs/comparisons.md has the method.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy import stats

from nermo_mjx.plotting.shown import CONFIDENCE_LEVEL, half_width, shown, spoken, titled
from nermo_mjx.runs.files import plain_json
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.counting import (
    Interval,
    Variants,
    counts,
    losses,
    losses_text,
    matched,
    two_stage,
)
from nermo_mjx.sweep.selection import Judged, judged
from nermo_mjx.sweep.spec import SoughtOptimum
from nermo_mjx.sweep.table import (
    Results,
    SweepRecord,
    columns_of,
    meta,
    profiles_of,
)


@dataclasses.dataclass(frozen=True)
class OptimumAnswer:
    """Where a metric is best in one group.

    Attributes:
        group: the columns that make groups, and their values here.
        points: the columns that tell the k points apart, (k,) each, SI units.
        mean: of the runs that chose, (k,), and `base_mean` that of the base; the same in fresh runs is in `lines`.
        judged: the best point, and its region.
        lines: metric -> what fresh runs say of it: means of the best point and the base, their difference, and the
            number of pairs, 0 where no seeds are common.
        lost: fresh runs that are lost, and why.
        rows: of the fresh run of the best point that is nearest to its mean, and of its partner in the base.
        further: numbers of the rows that are to be run, (m,).
    """

    group: Mapping[str, Any]
    points: Mapping[str, np.ndarray]
    mean: np.ndarray
    base_mean: float
    judged: Judged
    lines: Mapping[str, Mapping[str, float]]
    lost: Mapping[str, int]
    rows: tuple[int, ...]
    further: np.ndarray

    @property
    def at(self) -> dict[str, Any]:
        """The best point; empty without one."""
        return {
            name: column[self.judged.best]
            for name, column in self.points.items()
            if self.judged.best >= 0
        }


@dataclasses.dataclass(frozen=True)
class FoundOptimum:
    """The result of `find_optimum`.

    Attributes:
        asked: what was sought.
        results: the table.
        answers: of each group.
        metrics: metrics of the best points: the metric that was sought, then those of `_REPORTED`.
        over: what the intervals are over, in words.
    """

    asked: SoughtOptimum
    results: Results
    answers: tuple[OptimumAnswer, ...]
    metrics: tuple[str, ...]
    over: str

    @property
    def further(self) -> np.ndarray:
        """Numbers of all rows that are to be run, (m,)."""
        return np.unique(
            np.concatenate([np.empty(0, int), *(answer.further for answer in self.answers)])
        )

    @property
    def title(self) -> str:
        """What was sought, in words."""
        direction = "Highest" if self.asked.side == "max" else "Lowest"
        over = " and ".join(map(spoken, self.asked.over))
        return f"{direction} {spoken(self.asked.metric)} over {over}, against {self.base}"

    @property
    def base(self) -> str:
        """The base in words."""
        ((name, value),) = self.asked.base.items()
        if (name, value) in (("spine", "none"), ("spine.amplitude", 0)):
            return "the stiff spine"
        return f"{spoken(name)} {self.text(name, value)}"

    def text(self, name: str, value: Any) -> str:
        """A value of a varied column for people, with its unit."""
        if isinstance(value, str):
            return spoken(value)
        if value is None or value != value:  # a structure does not read it
            return "–"
        quantity = shown(name, meta(self.results.schema.field(name))["unit"], [value])
        return f"{round(float(quantity.values[0]), 9) + 0.0:.3g} {quantity.unit}".rstrip().replace(
            "-", "−"
        )

    def called(self, answer: OptimumAnswer) -> str:
        """A group in words, as a title begins with it."""
        return titled(", ".join(self.text(name, value) for name, value in answer.group.items()))

    def numbers(self, answer: OptimumAnswer, metric: str) -> tuple[str, str, str]:
        """A metric of the best point for people: its mean, and its difference from the base, with 95 % intervals."""
        line = answer.lines.get(metric)
        if line is None:
            return "–", "–", ""
        unit = meta(self.results.schema.field(metric))["unit"]
        shown_values = shown(metric, unit, [line["mean"], line["mean_high"] - line["mean"]])
        digits = (
            max(0, 1 - math.floor(math.log10(shown_values.values[1])))
            if shown_values.values[1] > 0
            else 2
        )
        mean = f"{shown_values.values[0]:.{digits}f} ± {shown_values.values[1]:.{digits}f} {shown_values.unit}".rstrip()
        return mean, *(_gain(line) if math.isfinite(line["relative"]) else ("–", ""))

    def region(self, answer: OptimumAnswer) -> str:
        """The region in words: 3 of 48 points: amplitude 0.3 to 0.4 rad, ..."""
        in_region, parts = answer.judged.region, list[str]()
        for name, values in answer.points.items():
            region_values = values[in_region].tolist()
            low, high = (
                self.text(name, bound) for bound in (min(region_values), max(region_values))
            )
            same_unit = low.partition(" ")[2] == high.partition(" ")[2]  # the unit
            parts.append(
                high if low == high else f"{low.partition(' ')[0] if same_unit else low} to {high}"
            )
        return f"{in_region.sum()} of {len(in_region)}: {', '.join(parts)}"

    def how(self) -> list[str]:
        """What the answers rest on, in sentences."""
        sentences = [
            f"Gains and costs are of fresh runs, which chose nothing, with 95 % intervals over {self.over}."
        ]
        for answer in self.answers:
            verdict, name = answer.judged, self.called(answer) or "All"
            why = {
                "few": f"no more than {self.asked.until} may be the best",
                "budget": "the budget is spent"
                if self.asked.budget
                else "no second stage was asked for",
                "lost": "of no two repeats all contenders have a number",
                "": f"{len(answer.further):,} more runs are needed",
            }[verdict.ended]
            out = int((~verdict.contenders).sum()) if verdict.ended and not verdict.spent else 0
            lost_note = f"; {out} points are out, because they lost runs" if out else ""
            fresh = ", no fresh runs yet"
            if answer.lines:
                pairs = next(iter(answer.lines.values()))["pairs"]
                single_note = (
                    f"{self.asked.fresh} fresh runs each, no pairs (randomize.paired makes them)"
                )
                fresh = f", {f'{pairs} fresh pairs' if pairs else single_note}{losses_text(answer.lost)}"
            fresh = ", no run of the base" if math.isnan(answer.base_mean) else fresh
            sentences.append(f"{name}: {verdict.runs} runs a point{fresh}; {why}{lost_note}.")
            if "r2" in (line := answer.lines.get(self.asked.metric, {})):
                explanation = str(self.asked.explain)
                unit = meta(self.results.schema.field(explanation))["unit"]
                sentences.append(
                    f"{name}: {spoken(explanation)} explains {100 * line['r2']:.0f} % of the variance of the gain, which "
                    f"changes by {100 * line['slope']:+.3g} points for 1 {unit if unit != '1' else 'more'} of it."
                )
            if outliers := answer.lines.get(self.asked.metric, {}).get("outliers", 0):
                sentences.append(
                    f"{name}: {outliers} of {answer.lines[self.asked.metric]['pairs']} pairs are outliers, more than five "
                    "standard deviations from the median: the interval can be too narrow."
                )
            for column, ends in self.ends(answer).items():
                sentences.append(f"{name}: the best {spoken(column)} is the {ends} that was tried.")
        return sentences

    def ends(self, answer: OptimumAnswer) -> dict[str, str]:
        """Columns in which the best point is the `largest` or `smallest` of all; angles all around have no ends."""
        texts = dict[str, str]()
        for name, values in answer.points.items():
            if not answer.at or values.dtype.kind != "f":
                continue
            low, high = np.nanmin(values), np.nanmax(values)
            around_all = (
                meta(self.results.schema.field(name))["unit"] == "rad" and high - low > 1.5 * np.pi
            )
            if low < high and not around_all and answer.at[name] in (low, high):
                texts[name] = "largest" if answer.at[name] == high else "smallest"
        return texts

    def shown_rows(self) -> dict[int, str]:
        """A typical fresh run of each best point and its partner in the base, and what each is."""
        sides = (f"best by {self.asked.metric}", self.base)
        return {
            row: f"{self.called(answer)}, {side}".lstrip(", ")
            for answer in self.answers
            for row, side in zip(answer.rows, sides, strict=False)
        }

    def about(self) -> dict[str, Any]:
        """All of it for JSON, SI units."""
        answers = []
        for answer in self.answers:
            verdict = answer.judged
            places = np.flatnonzero(verdict.region).tolist() if verdict.best >= 0 else []
            region = [{name: column[i] for name, column in answer.points.items()} for i in places]
            fields = {
                "for": answer.group,
                "at": answer.at,
                "region": region,
                "points": len(verdict.region),
            }
            fields |= {"ended": verdict.ended, "spent": verdict.spent, "runs": verdict.runs}
            answers.append(
                fields | {"lost": answer.lost, "rows": answer.rows, "metrics": answer.lines}
            )
        question = {"metric": self.asked.metric, "side": self.asked.side, "base": self.asked.base}
        return {
            **question,
            "intervals_over": self.over,
            "profiles": profiles_of(self.results),
            "answers": answers,
        }


#: Metrics that are reported with the metric that is sought, if a table has them: both costs, and the fraction of time in
#: which the spine's servo is at its torque limit.
_REPORTED: Final = ("cost_of_transport", "electrical_cost_of_transport", "limited_spine")


@dataclasses.dataclass(frozen=True)
class _Runs:
    """What an optimum is found in: columns of a table, (runs,) each.

    Attributes:
        row, repeat, seed: index columns.
        variants: the variants of the runs.
        metrics, good: the values of each metric, and which runs count for it.
        status: how the runs ended.
        chose: the runs that choose the best point; the others are fresh.
        samples: Random parameters of the runs, (runs, draws), as distances from the means of their distributions.
        explanation: Random parameter that is to explain the gains, (runs,), or None.
    """

    row: np.ndarray
    repeat: np.ndarray
    seed: np.ndarray
    variants: Variants
    metrics: Mapping[str, np.ndarray]
    good: Mapping[str, np.ndarray]
    status: np.ndarray
    chose: np.ndarray
    samples: np.ndarray
    explanation: np.ndarray | None


def find_optimum(
    results: Results, question: SoughtOptimum, repeats: int, variants: int
) -> FoundOptimum:
    """Where a table says that a metric is best, as far as its runs are there.

    Args:
        results: the table of a sweep.
        question: what is sought.
        repeats, variants: of the sweep, before further runs of some variants.
    """
    names, ((by, base),) = columns_of(results, "varied"), question.base.items()
    metrics = tuple(
        dict.fromkeys(
            [question.metric, *(name for name in _REPORTED if name in results.schema.names)]
        )
    )
    columns = dict(results.columns(["row", "variant", "repeat", "seed", *names, *metrics]))
    variant_set, repeat = Variants.of(columns["variant"]), columns["repeat"]
    value = {name: columns[name][variant_set.first] for name in names}
    runs = _Runs(
        row=columns["row"],
        repeat=repeat,
        seed=columns["seed"],
        variants=variant_set,
        metrics={name: columns[name] for name in metrics},
        good={name: counts(name, columns[name], results.well) for name in metrics},
        status=results.column("status"),
        chose=(repeat < repeats) | (repeat >= repeats + question.fresh),
        samples=_samples_of(results),
        explanation=results.column(question.explain) if question.explain else None,
    )
    groups = question.grouped(names)
    of_base = np.array([same_value(number, base) for number in value[by]])
    labels: list[tuple[Any, ...]] = [()]
    if groups:
        labels = list(
            dict.fromkeys(zip(*(plain_json(value[name][~of_base]) for name in groups), strict=True))
        )
    answers = []
    for label in labels:
        group = dict(zip(groups, label, strict=True))
        # A base that does not read a column is the base of all of its values.
        alike = [
            np.array(
                [same_value(number, group_values) or number != number for number in value[name]]
            )
            for name, group_values in group.items()
        ]
        in_group = np.logical_and.reduce([np.full(len(of_base), True), *alike])
        points, bases = np.flatnonzero(in_group & ~of_base), np.flatnonzero(in_group & of_base)
        axes = {name: value[name][points] for name in dict.fromkeys((*question.over, by))}
        axes = {
            name: axis for name, axis in axes.items() if name in question.over or len(set(axis)) > 1
        }
        answers.append(_answer(runs, question, group, axes, (points, bases), (repeats, variants)))
    randomized = columns_of(results, "randomized")
    over = dict.fromkeys(
        "starts" if name.startswith("start.") else spoken(name) for name in randomized
    )
    if "body" in results.schema.names:
        over = {"bodies": None, **{name: None for name in over if name == "starts"}}
    return FoundOptimum(question, results, tuple(answers), metrics, ", ".join(over) or "starts")


def _samples_of(results: Results) -> np.ndarray:
    """Random parameters of all runs, (runs, draws), as distances from the means of their distributions."""
    means = {
        name: float(text)
        for name in columns_of(results, "randomized")
        if (text := meta(results.schema.field(name)).get("mean"))
    }
    distances = [results.column(name) - mean for name, mean in means.items()]
    return np.nan_to_num(np.array(distances).reshape(len(means), -1).T)


def _answer(
    runs: _Runs,
    question: SoughtOptimum,
    group: Mapping[str, Any],
    axes: Mapping[str, np.ndarray],
    places: tuple[np.ndarray, np.ndarray],
    size: tuple[int, int],
) -> OptimumAnswer:
    """The answer for one group.

    Args:
        group, axes: as in `OptimumAnswer`, axes its `points`.
        places: of its points and bases among the variants.
        size: repeats and variants of the sweep.
    """
    (points, bases), (repeats, variants) = places, size
    variant_set, repeat, metric = runs.variants, runs.repeat, runs.metrics[question.metric]
    point_of_variant = np.full(len(variant_set.first), -1)
    point_of_variant[points] = np.arange(len(points))
    point_rows = np.flatnonzero(point_of_variant[variant_set.place] >= 0)
    shape = int(repeat.max()) + 1, len(points)
    values, is_there = np.full(shape, np.nan), np.full(shape, False)
    cell, sign = (
        (repeat[point_rows], point_of_variant[variant_set.place[point_rows]]),
        1 if question.side == "max" else -1,
    )
    good = runs.good[question.metric]
    values[cell] = np.where(good[point_rows], sign * metric[point_rows], np.nan)
    is_there[cell] = True
    verdict = judged(values, is_there, question, repeats)
    tally = variant_set.tally(np.where(runs.chose, metric, np.nan), good & runs.chose)
    of_bases = np.isin(variant_set.place, bases) & good & runs.chose
    base_mean = float(metric[of_bases].mean()) if of_bases.any() else math.nan
    further_rows = verdict.wanted[0] * variants + variant_set.number[points[verdict.wanted[1]]]
    lines, lost_counts, rows = dict[str, dict[str, float]](), dict[str, int](), tuple[int, ...]()
    if verdict.best >= 0 and len(bases):
        sides = [bases[0], points[verdict.best]]
        fresh = [np.flatnonzero((variant_set.place == side) & ~runs.chose) for side in sides]
        numbers = np.arange(repeats, repeats + question.fresh)
        ahead = [np.setdiff1d(numbers, repeat[side]) for side in fresh]
        further_rows = np.concatenate(
            [
                lacking * variants + variant_set.number[side]
                for lacking, side in zip(ahead, sides, strict=True)
            ]
        )
        if min(map(len, fresh)) > 1:
            lines, lost_counts, rows = _fresh(runs, question.metric, fresh)
    return OptimumAnswer(
        group, axes, tally.mean[points], base_mean, verdict, lines, lost_counts, rows, further_rows
    )


def _fresh(
    runs: _Runs, metric: str, fresh: Sequence[np.ndarray]
) -> tuple[dict[str, dict[str, float]], dict[str, int], tuple[int, ...]]:
    """What fresh runs of the base and of the best point say: `lines`, `lost` and `rows` of the answer."""
    lines = {
        name: line
        for name, values in runs.metrics.items()
        if (
            line := _measured(
                values, runs.good[name], runs.seed, fresh, runs.samples, runs.explanation
            )
        )
    }
    fresh_rows = np.concatenate(fresh)
    lost_counts = losses(runs.status[fresh_rows], runs.good[metric][fresh_rows])
    if not lines:
        return lines, lost_counts, ()
    # The run that is nearest to the mean, and its partner in the base, or another one of it.
    base, best = (side[runs.good[metric][side]] for side in fresh)
    typical = best[np.abs(runs.metrics[metric][best] - lines[metric]["mean"]).argmin()]
    partner = base[np.argmax(runs.seed[base] == runs.seed[typical])]
    return lines, lost_counts, (int(runs.row[typical]), int(runs.row[partner]))


def optimum_in(out: Path) -> FoundOptimum | None:
    """What the table of a sweep's directory says of the optimum that it seeks; None if it seeks none."""
    record, files = SweepRecord.of_directory(out), part_files(out)
    if record is None or record.optimum is None or not files:
        return None
    return find_optimum(
        Results(files),
        SoughtOptimum.model_validate(record.optimum),
        record.repeats,
        record.variants,
    )


def same_value(value: Any, target: Any) -> bool:
    """Whether a value of a column is the wanted one; numbers may differ in their last digits."""
    if isinstance(value, str) or isinstance(target, str):
        return bool(value == target)
    return bool(value is not None and math.isclose(value, target, rel_tol=1e-12, abs_tol=1e-12))


def _measured(
    values: np.ndarray,
    good: np.ndarray,
    seed: np.ndarray,
    fresh: Sequence[np.ndarray],
    samples: np.ndarray,
    explanation: np.ndarray | None,
) -> dict[str, float]:
    """Means of the base's and the best point's fresh runs with 95 % intervals, and those of their difference.

    The relative difference of pairs is the geometric mean of their ratios.

    Args:
        values, good, seed: Of all runs, (runs,): the metric, whether it counts, and the seed.
        fresh: Rows of the fresh runs of the base and of the best point.
        samples: Random parameters of all runs, (runs, draws), which explain a part of the differences of pairs.
        explanation: Random parameter of all runs, (runs,), for the line of the relative differences over it.

    Returns:
        Numbers by name; empty if one side has no run that counts.
    """
    import pandas as pd

    sides = [
        pd.DataFrame(
            {"value": values[rows], "row": rows},
            pd.MultiIndex.from_arrays([0 * rows, seed[rows]]),
        )
        for rows in fresh
    ]
    (base, best), paired = matched(sides, [good[rows] for rows in fresh])
    if base.empty or best.empty:
        return {}
    first, second = base.value.to_numpy(), best.value.to_numpy()
    line = dict[str, float]()
    for name, side_values in (("mean", second), ("base", first)):
        spread = side_values.std(ddof=1) if len(side_values) > 1 else math.nan
        half = float(half_width(spread, len(side_values)))
        line |= {
            name: float(side_values.mean()),
            f"{name}_low": side_values.mean() - half,
            f"{name}_high": side_values.mean() + half,
        }
    # Where the base's mean is nothing but noise, no share of it says anything.
    scale = abs(line["base"]) if abs(line["base"]) > line["base_high"] - line["base"] else math.nan
    observed = np.concatenate([first, second])[:, None]
    if not len(paired):
        cells = np.repeat([0, 1], [len(first), len(second)])
        signed_values = np.concatenate([-first, second])[:, None]
        interval = two_stage(signed_values, cells, np.zeros(2, int), None, observed)
        relative = Interval(*(bound / scale for bound in interval))
    else:
        rows = best.row.to_numpy().astype(int)
        difference = second - first
        interval = _mean_of_pairs(difference, samples[rows], observed)
        relative, gains = Interval(*(bound / scale for bound in interval)), difference / scale
        if math.isfinite(scale) and (first * second > 0.0).all():
            gains = second / first - 1.0
            logarithms = _mean_of_pairs(np.log1p(gains), samples[rows], np.log(np.abs(observed)))
            relative = Interval(*(np.expm1(bound) for bound in logarithms))
        line["outliers"] = int(_outliers(difference).sum())
        if explanation is not None and np.ptp(explanation[rows]) > 0.0 and math.isfinite(scale):
            fit = stats.linregress(explanation[rows], gains)
            line |= {"slope": float(fit.slope), "r2": float(fit.rvalue**2)}
    names = ("difference", "low", "high", "p", "relative", "relative_low", "relative_high")
    bounds = (*interval, *relative[:3])
    line |= {name: float(bound[0]) for name, bound in zip(names, bounds, strict=True)}
    return line | {"pairs": len(first) * bool(len(paired))}


#: Pairs for each random parameter, below which a regression on the parameters is not tried.
_PAIRS_PER_SAMPLE: Final = 2


def _mean_of_pairs(differences: np.ndarray, samples: np.ndarray, observed: np.ndarray) -> Interval:
    """The mean of pairs over the distribution of their random parameters, with its 95 % interval.

    A linear regression on the parameters, at the mean of their distributions, so that the interval contains the noise of
    the pairs and not the distance of the sample's mean from that of the distribution. With fewer than
    `_PAIRS_PER_SAMPLE` pairs for each parameter, and for equal differences, it is Student's interval of the mean.

    Args:
        differences: Differences of the pairs, (n,).
        samples: Random parameters as distances from the means of their distributions, (n, draws).
        observed: Argument of `two_stage`.
    """
    samples = samples[:, np.ptp(samples, axis=0) > 0.0]
    count, parameters = samples.shape
    plain = two_stage(differences[:, None], np.zeros(count, int), np.zeros(1, int), None, observed)
    if not parameters or count < _PAIRS_PER_SAMPLE * (parameters + 1) or not differences.std():
        return plain
    design = np.column_stack([np.ones(count), samples / np.abs(samples).max(axis=0)])
    coefficients, _, rank, _ = np.linalg.lstsq(design, differences, rcond=None)
    freedom = count - rank
    variance = float(((differences - design @ coefficients) ** 2).sum()) / freedom
    error = math.sqrt(variance * float(np.linalg.pinv(design.T @ design)[0, 0]))
    half = float(stats.t.ppf((1 + CONFIDENCE_LEVEL) / 2, freedom)) * error
    mean = coefficients[:1]
    p = 2 * stats.t.sf(np.abs(mean) / error, freedom) if error else plain.p
    return Interval(mean, mean - half, mean + half, p)


def _outliers(differences: np.ndarray) -> np.ndarray:
    """Which differences (n,) lie more than five standard deviations of normal noise from their median, (n,).

    >>> _outliers(np.array([1.0, 1.1, 0.9, 1.05, 0.95, -9.0])).tolist()
    [False, False, False, False, False, True]
    """
    distance = np.abs(differences - np.median(differences))
    # The median distance of normal noise is 0.674 standard deviations.
    return np.asarray(distance > 5.0 * np.median(distance) / 0.674)


def _gain(line: Mapping[str, float]) -> tuple[str, str]:
    """A relative difference in percent and its interval, as texts."""
    ends = (f"{100 * line[f'relative_{end}']:+.1f}".replace("-", "−") for end in ("low", "high"))
    return f"{100 * line['relative']:+.1f} %".replace("-", "−"), f"[{', '.join(ends)}]"
