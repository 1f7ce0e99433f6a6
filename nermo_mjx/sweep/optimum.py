"""Where a metric is best: for each group the best point, the points that cannot be told from it, and what it gains.

The first runs of all points choose, and those of a second stage, which goes on where the best may be. Fresh runs of the
best point and of its base measure the gain: they chose nothing, so that no luck of the choice is in it. All of them are
rows of the sweep's table, and what is still to be run follows from the table alone; docs/comparisons.md has the method.
"""

from __future__ import annotations

import dataclasses
import functools
import io
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter
from pyarrow import csv
from scipy import optimize, special, stats

from nermo_mjx.plotting.charts import (
    around,
    blank,
    cell_edges,
    cell_means,
    colour_bar,
    set_scales,
    signed,
)
from nermo_mjx.plotting.shown import (
    CONFIDENCE_LEVEL,
    ShownValues,
    half_width,
    shown,
    spoken,
    titled,
)
from nermo_mjx.plotting.style import (
    BEST_COLOUR,
    GAIN_COLOUR_MAP,
    GRID,
    INK,
    MISSING_COLOUR,
    MUTED_INK,
    SERIES,
)
from nermo_mjx.runs.files import plain_json
from nermo_mjx.runs.rows import part_files
from nermo_mjx.sweep.counting import Variants, counts, losses, matched, told, two_stage
from nermo_mjx.sweep.spec import SoughtOptimum
from nermo_mjx.sweep.table import (
    Columns,
    Results,
    SweepRecord,
    columns_of,
    meta,
    profile_text,
    profiles_of,
)

# ---
# Multiple comparisons with the best: which points the data cannot tell from the best one.
#
# Hsu (Ann. Stat. 12, 1984): a point may be the best unless its mean is further below the highest one than the largest
# of its differences to the others would be by chance. Runs of a repeat share their draws, and count by their distance
# from the repeat's mean (Nelson and Matejcik, Manage. Sci. 41, 1995); the noise of all contenders is one number. Points
# far below are left out first, at a tenth of the error, so that neither their number nor their noise counts.

#: Probability of losing the best point before the last look, of all of 1 - `CONFIDENCE_LEVEL`.
EARLY: Final = 0.01
#: Share of a look's error that the points far below take.
_SCREENED: Final = 0.1


@functools.lru_cache(4096)
def hsu_margin(points: int, freedom: int, level: float, skew: float = 0.0) -> float:
    """How many standard errors of a difference the best of some points lies below the highest mean by chance, at most.

    The quantile of the largest of k - 1 Student's t that share one of their two sides and the estimate of the noise; of
    means whose noise has a positive skewness, it is that of Pearson's third kind.

    >>> round(hsu_margin(2, 10, 0.95), 2), round(hsu_margin(5, 10, 0.95), 2)
    (1.81, 2.46)
    """
    middle, shares = (np.arange(100) + 0.5) / 100, (np.arange(60) + 0.5) / 60
    scale = np.sqrt(2 * stats.chi2.ppf(shares, freedom) / freedom)
    below, places = special.ndtr, special.ndtri(middle)
    if skew:
        shape = 4.0 / skew**2  # of a gamma distribution
        below, places = (
            functools.partial(special.gammainc, shape),
            special.gammaincinv(shape, middle),
        )
        scale *= math.sqrt(shape)

    def beyond(far: float) -> float:
        return float((below(places[:, None] + far * scale) ** (points - 1)).mean()) - level

    return float(optimize.brentq(beyond, 0.0, 500.0, xtol=1e-4))


def undistinguished(values: np.ndarray, level: float = CONFIDENCE_LEVEL) -> np.ndarray:
    """Which points may be the best, (k,) bool: the best one is among them with this probability at least.

    >>> undistinguished(np.array([[1.0, 5.0, 5.1], [1.1, 5.2, 5.1], [0.9, 5.1, 5.0], [1.0, 5.0, 5.0]])).tolist()
    [False, True, True]

    Args:
        values: of each repeat and point, (n, k), all finite; higher is better.
        level: the probability.
    """
    mean, best, kept = (
        values.mean(axis=0),
        int(values.mean(axis=0).argmax()),
        np.full(values.shape[1], True),
    )
    skew = _skewness(values) / math.sqrt(len(values))
    for share in (_SCREENED, 1 - _SCREENED):
        if (many := int(kept.sum())) > 1:
            own, freedom = values[:, kept], (len(values) - 1) * (many - 1)
            rest = own - own.mean(axis=0) - own.mean(axis=1, keepdims=True) + own.mean()
            noise = np.full(len(mean), math.sqrt((rest**2).sum() / freedom))
            if share == _SCREENED:  # a point that is noisier than most is not lost for it
                noise = np.maximum(
                    noise, (values - values[:, [best]]).std(axis=0, ddof=1) / math.sqrt(2)
                )
            margin = hsu_margin(many, freedom, 1 - share * (1 - level), round(skew, 1))
            kept &= mean >= mean[best] - margin * noise * math.sqrt(2 / len(values))
    return kept


def _skewness(values: np.ndarray) -> float:
    """Of the noise of each value (n, k), if it is positive, which makes the highest mean one of luck; else 0.

    Of residuals about the means of repeats and points, whose second and third cumulants are smaller by known factors.
    """
    rest = values - values.mean(axis=0) - values.mean(axis=1, keepdims=True) + values.mean()
    second, third = (
        math.prod(1 - m / size for size in values.shape for m in range(1, upto)) for upto in (2, 3)
    )
    square = float((rest**2).mean()) / second
    return max(0.0, float((rest**3).mean()) / third / square**1.5) if third * square > 0.0 else 0.0


@dataclasses.dataclass(frozen=True)
class Judged:
    """What the runs of k points tell of the best one.

    Attributes:
        best: its place; -1 where nothing can be told.
        region: the points that cannot be told from it, (k,) bool.
        contenders: the points with the fewest lost runs, (k,) bool; only they can be the best.
        runs: of each point of the region.
        spent: runs of the second stage.
        wanted: repeats and points that are to be run before more can be told, (m,) each.
        ended: why no more runs are wanted: `few` points are left, the `budget` is spent, or `lost`: of no two repeats
            all contenders have a number; empty while runs are wanted.
    """

    best: int
    region: np.ndarray
    contenders: np.ndarray
    runs: int
    spent: int
    wanted: tuple[np.ndarray, np.ndarray]
    ended: str


def judged(values: np.ndarray, there: np.ndarray, asked: SoughtOptimum, repeats: int) -> Judged:
    """Judge points by the runs that are there, one block of repeats after the other.

    Args:
        values: of each repeat and point, (n, k); higher is better; NaN where a run is lost or not there.
        there: which runs have been made, (n, k) bool.
        asked: what is sought.
        repeats: runs of each point in the first block, and in each further one.
    """
    alive, block, spent, none = (
        np.full(values.shape[1], True),
        np.arange(repeats),
        0,
        (np.empty(0, int),) * 2,
    )
    for look in itertools.count(1):
        lacking = (
            ~np.array([there[i] if i < len(there) else np.zeros(len(alive), bool) for i in block])
            & alive
        )
        if lacking.any():
            rows, points = np.nonzero(lacking)
            return Judged(-1, alive, alive, len(block), spent, (block[rows], points), "")
        known = np.isfinite(values[block])
        lost = (~known).sum(axis=0)
        alive &= lost == lost[alive].min()
        used = values[block[known[:, alive].all(axis=1)]][:, alive]
        if len(used) < 2:
            return Judged(-1, alive, alive, len(block), spent, none, "lost")
        early, last, contenders = alive.copy(), alive.copy(), alive.copy()
        early[alive] = undistinguished(used, 1 - EARLY / 2**look)
        last[alive] = undistinguished(used, CONFIDENCE_LEVEL + (EARLY if asked.budget else 0.0))
        price, few = int(early.sum()) * repeats, bool(asked.budget) and early.sum() <= asked.until
        best = int(np.flatnonzero(alive)[used.mean(axis=0).argmax()])
        if few or spent + price > asked.budget:
            region = early if few else last
            few |= bool(asked.budget) and region.sum() <= asked.until
            return Judged(
                best, region, contenders, len(block), spent, none, "few" if few else "budget"
            )
        alive, spent = early, spent + price
        begin = asked.fresh + look * repeats
        block = np.append(block, np.arange(begin, begin + repeats))
    raise AssertionError("a budget is finite")


# ---
# The answer of a table, for each group.


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
            name: each[self.judged.best]
            for name, each in self.points.items()
            if self.judged.best >= 0
        }


@dataclasses.dataclass(frozen=True)
class FoundOptimum:
    """The result of `find_optimum`.

    Attributes:
        asked: what was sought.
        results: the table.
        answers: of each group.
        metrics: what is told of the best points: what was sought, then both costs of transport.
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
            np.concatenate([np.empty(0, int), *(each.further for each in self.answers)])
        )

    @property
    def title(self) -> str:
        """What was sought, in words."""
        most = "Highest" if self.asked.side == "max" else "Lowest"
        over = " and ".join(map(spoken, self.asked.over))
        return f"{most} {spoken(self.asked.metric)} over {over}, against {self.base}"

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
        own = shown(metric, unit, [line["mean"], line["mean_high"] - line["mean"]])
        digits = max(0, 1 - math.floor(math.log10(own.values[1]))) if own.values[1] > 0 else 2
        mean = f"{own.values[0]:.{digits}f} ± {own.values[1]:.{digits}f} {own.unit}".rstrip()
        return mean, *(_gain(line) if math.isfinite(line["relative"]) else ("–", ""))

    def region(self, answer: OptimumAnswer) -> str:
        """The region in words: 3 of 48 points: amplitude 0.3 to 0.4 rad, ..."""
        kept, parts = answer.judged.region, list[str]()
        for name, values in answer.points.items():
            own = values[kept].tolist()
            low, high = (self.text(name, each) for each in (min(own), max(own)))
            same = low.partition(" ")[2] == high.partition(" ")[2]  # the unit
            parts.append(
                high if low == high else f"{low.partition(' ')[0] if same else low} to {high}"
            )
        return f"{kept.sum()} of {len(kept)}: {', '.join(parts)}"

    def how(self) -> list[str]:
        """What the answers rest on, in sentences."""
        said = [
            f"Gains and costs are of fresh runs, which chose nothing, with 95 % intervals over {self.over}."
        ]
        for answer in self.answers:
            found, name = answer.judged, self.called(answer) or "All"
            why = {
                "few": f"no more than {self.asked.until} may be the best",
                "budget": "the budget is spent"
                if self.asked.budget
                else "no second stage was asked for",
                "lost": "of no two repeats all contenders have a number",
                "": f"{len(answer.further):,} more runs are needed",
            }[found.ended]
            out = int((~found.contenders).sum()) if found.ended and not found.spent else 0
            lost = f"; {out} points are out, because they lost runs" if out else ""
            fresh = ", no fresh runs yet"
            if answer.lines:
                pairs = next(iter(answer.lines.values()))["pairs"]
                alone = (
                    f"{self.asked.fresh} fresh runs each, no pairs (randomize.paired makes them)"
                )
                fresh = f", {f'{pairs} fresh pairs' if pairs else alone}{told(answer.lost)}"
            fresh = ", no run of the base" if math.isnan(answer.base_mean) else fresh
            said.append(f"{name}: {found.runs} runs a point{fresh}; {why}{lost}.")
            for column, ends in self.ends(answer).items():
                said.append(f"{name}: the best {spoken(column)} is the {ends} that was tried.")
        return said

    def ends(self, answer: OptimumAnswer) -> dict[str, str]:
        """Columns in which the best point is the `largest` or `smallest` of all; angles all around have no ends."""
        found = dict[str, str]()
        for name, values in answer.points.items():
            if not answer.at or values.dtype.kind != "f":
                continue
            low, high = np.nanmin(values), np.nanmax(values)
            around_all = (
                meta(self.results.schema.field(name))["unit"] == "rad" and high - low > 1.5 * np.pi
            )
            if low < high and not around_all and answer.at[name] in (low, high):
                found[name] = "largest" if answer.at[name] == high else "smallest"
        return found

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
        each = []
        for answer in self.answers:
            found = answer.judged
            places = np.flatnonzero(found.region).tolist() if found.best >= 0 else []
            region = [{name: column[i] for name, column in answer.points.items()} for i in places]
            about = {
                "for": answer.group,
                "at": answer.at,
                "region": region,
                "points": len(found.region),
            }
            about |= {"ended": found.ended, "spent": found.spent, "runs": found.runs}
            each.append(about | {"lost": answer.lost, "rows": answer.rows, "metrics": answer.lines})
        asked = {"metric": self.asked.metric, "side": self.asked.side, "base": self.asked.base}
        return {
            **asked,
            "intervals_over": self.over,
            "profiles": profiles_of(self.results),
            "answers": each,
        }


#: Told beside what is sought, where a table has them.
_COSTS: Final = ("cost_of_transport", "electrical_cost_of_transport")


def find_optimum(
    results: Results, asked: SoughtOptimum, repeats: int, variants: int
) -> FoundOptimum:
    """Where a table says that a metric is best, as far as its runs are there.

    Args:
        results: the table of a sweep.
        asked: what is sought.
        repeats, variants: of the sweep, before further runs of some variants.
    """
    names, ((by, base),) = columns_of(results, "varied"), asked.base.items()
    metrics = tuple(
        dict.fromkeys([asked.metric, *(name for name in _COSTS if name in results.schema.names)])
    )
    wanted = ["row", "variant", "repeat", "seed", *names, *metrics]
    row, number, repeat, seed, *columns = (column for _, column in results.columns(wanted))
    found = Variants.of(number)
    value = {name: column[found.first] for name, column in zip(names, columns, strict=False)}
    metric = dict(zip(metrics, columns[len(names) :], strict=True))
    good = {name: counts(name, column, results.well) for name, column in metric.items()}
    groups = asked.grouped(names)
    of_base = np.array([same_value(each, base) for each in value[by]])
    labels: list[tuple[Any, ...]] = [()]
    if groups:
        labels = list(
            dict.fromkeys(zip(*(plain_json(value[name][~of_base]) for name in groups), strict=True))
        )
    status, answers = results.column("status"), []
    for label in labels:
        group = dict(zip(groups, label, strict=True))
        # A base that does not read a column is the base of all of its values.
        alike = [
            np.array([same_value(each, own) or each != each for each in value[name]])
            for name, own in group.items()
        ]
        here = np.logical_and.reduce([np.full(len(of_base), True), *alike])
        points, bases = np.flatnonzero(here & ~of_base), np.flatnonzero(here & of_base)
        told_apart = {name: value[name][points] for name in dict.fromkeys((*asked.over, by))}
        told_apart = {
            name: each
            for name, each in told_apart.items()
            if name in asked.over or len(set(each)) > 1
        }
        place = np.full(len(of_base), -1)
        place[points] = np.arange(len(points))
        runs = np.flatnonzero(place[found.place] >= 0)
        shape = int(repeat.max()) + 1, len(points)
        values, there = np.full(shape, np.nan), np.full(shape, False)
        cell = repeat[runs], place[found.place[runs]]
        own = metric[asked.metric][runs]
        values[cell] = np.where(
            good[asked.metric][runs], own if asked.side == "max" else -own, np.nan
        )
        there[cell] = True
        verdict = judged(values, there, asked, repeats)
        chose = (repeat < repeats) | (repeat >= repeats + asked.fresh)
        tally = found.tally(
            np.where(chose, metric[asked.metric], np.nan), good[asked.metric] & chose
        )
        of_bases = np.isin(found.place, bases) & good[asked.metric] & chose
        base_mean = float(metric[asked.metric][of_bases].mean()) if of_bases.any() else math.nan
        further = verdict.wanted[0] * variants + found.number[points[verdict.wanted[1]]]
        lines, lost = dict[str, dict[str, float]](), dict[str, int]()
        rows = tuple[int, ...]()
        if verdict.best >= 0 and len(bases):
            sides = [bases[0], points[verdict.best]]
            fresh = [np.flatnonzero((found.place == side) & ~chose) for side in sides]
            ahead = [
                np.setdiff1d(np.arange(repeats, repeats + asked.fresh), repeat[side])
                for side in fresh
            ]
            further = np.concatenate(
                [
                    each * variants + found.number[side]
                    for each, side in zip(ahead, sides, strict=True)
                ]
            )
            if min(map(len, fresh)) > 1:
                lines = {
                    name: line
                    for name in metrics
                    if (line := _measured(metric[name], good[name], seed, fresh))
                }
                both = np.concatenate(fresh)
                lost = losses(status[both], good[asked.metric][both])
                told_of = [side[good[asked.metric][side]] for side in fresh]
                if lines:  # the run that is nearest to the mean, and its partner in the base, or another one of it
                    typical = told_of[1][
                        np.abs(
                            metric[asked.metric][told_of[1]] - lines[asked.metric]["mean"]
                        ).argmin()
                    ]
                    partner = told_of[0][np.argmax(seed[told_of[0]] == seed[typical])]
                    rows = int(row[typical]), int(row[partner])
        answers.append(
            OptimumAnswer(
                group,
                told_apart,
                tally.mean[points],
                base_mean,
                verdict,
                lines,
                lost,
                rows,
                further,
            )
        )
    drawn = columns_of(results, "randomized")
    over = dict.fromkeys("starts" if name.startswith("start.") else spoken(name) for name in drawn)
    if "body" in results.schema.names:
        over = {"bodies": None, **{name: None for name in over if name == "starts"}}
    return FoundOptimum(asked, results, tuple(answers), metrics, ", ".join(over) or "starts")


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


def same_value(value: Any, wanted: Any) -> bool:
    """Whether a value of a column is the wanted one; numbers may differ in their last digits."""
    if isinstance(value, str) or isinstance(wanted, str):
        return bool(value == wanted)
    return bool(value is not None and math.isclose(value, wanted, rel_tol=1e-12, abs_tol=1e-12))


def _measured(
    values: np.ndarray, good: np.ndarray, seed: np.ndarray, fresh: Sequence[np.ndarray]
) -> dict[str, float]:
    """Means of the base's and the best point's fresh runs with their 95 % intervals, and the same of their difference;
    of pairs, where seeds are common; empty where one side has no run that counts."""
    import pandas as pd

    sides = [
        pd.DataFrame({"m": values[own]}, pd.MultiIndex.from_arrays([0 * own, seed[own]]))
        for own in fresh
    ]
    (base, best), paired = matched(sides, [good[own] for own in fresh])
    if base.empty or best.empty:
        return {}
    first, second = base.m.to_numpy(), best.m.to_numpy()
    if len(paired):
        found = two_stage((second - first)[:, None], np.zeros(len(first), int), np.zeros(1, int))
    else:
        cells = np.repeat([0, 1], [len(first), len(second)])
        found = two_stage(np.concatenate([-first, second])[:, None], cells, np.zeros(2, int))
    low, middle, high = (float(each[0]) for each in (found.low, found.estimate, found.high))
    line = dict[str, float]()
    for name, own in (("mean", second), ("base", first)):
        half = float(half_width(own.std(ddof=1) if len(own) > 1 else math.nan, len(own)))
        line |= {
            name: float(own.mean()),
            f"{name}_low": own.mean() - half,
            f"{name}_high": own.mean() + half,
        }
    # Where the base's mean is nothing but noise, no share of it says anything.
    scale = abs(line["base"]) if abs(line["base"]) > line["base_high"] - line["base"] else math.nan
    line |= {
        "difference": middle,
        "low": low,
        "high": high,
        "p": float(found.p[0]),
        "pairs": len(first) * bool(len(paired)),
    }
    return line | {
        "relative": middle / scale,
        "relative_low": low / scale,
        "relative_high": high / scale,
    }


def _gain(line: Mapping[str, float]) -> tuple[str, str]:
    """A relative difference in percent and its interval, as texts."""
    ends = (f"{100 * line[f'relative_{end}']:+.1f}".replace("-", "−") for end in ("low", "high"))
    return f"{100 * line['relative']:+.1f} %".replace("-", "−"), f"[{', '.join(ends)}]"


# ---
# The answer as a table: of a terminal, as CSV, as LaTeX, and as Parquet.


def optimum_cells(found: FoundOptimum) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the short table for people, a line for each group: means ± half an interval, and gains."""
    heads = [*map(titled, found.answers[0].group), *map(titled, found.answers[0].points)]
    heads += [*map(titled, found.metrics), "Not told from it"]
    lines = []
    for answer in found.answers:
        line = [titled(found.text(name, value)) for name, value in answer.group.items()]
        if answer.at:
            line += [found.text(name, value) for name, value in answer.at.items()]
            for name in found.metrics:
                mean, *gain = found.numbers(answer, name)
                line.append(f"{mean} ({' '.join(gain)})")
            line.append(found.region(answer))
        lines.append([*line, *["–"] * (len(heads) - len(line))])
    return heads, lines


def optimum_latex(found: FoundOptimum) -> str:
    """The short table as a LaTeX tabular, without packages."""
    heads, lines = optimum_cells(found)
    marks = {"%": r"\%", "±": r"$\pm$", "−": "$-$", "–": "--", "_": r"\_", "&": r"\&"}
    rows = [
        " & ".join("".join(marks.get(sign, sign) for sign in cell) for cell in line)
        for line in (heads, *lines)
    ]
    body = [f"{rows[0]} \\\\ \\hline", *(f"{row} \\\\" for row in rows[1:])]
    notes = [
        f"% {each}"
        for each in (
            f"{profile_text(profiles_of(found.results))}; base: {found.base}",
            *found.how(),
        )
    ]
    return "\n".join(
        [*notes, f"\\begin{{tabular}}{{{'l' * len(heads)}}}", *body, "\\end{tabular}", ""]
    )


def optimum_table(found: FoundOptimum) -> pa.Table:
    """A row for each group and metric, SI units: the best point, and what fresh runs say of it."""
    lines = [
        {**answer.group, **answer.at, "metric": name, "region": int(answer.judged.region.sum())}
        | dict(line)
        for answer in found.answers
        for name, line in answer.lines.items()
    ]
    columns, schema = Columns(), found.results.schema
    for name in dict.fromkeys(itertools.chain(*lines)):
        about = meta(schema.field(name)) if name in schema.names else {}
        role = "varied" if about else "index" if name in ("metric", "region") else "metric"
        doc = about.get("description", _FIELDS.get(name, name))
        unit = about.get(
            "unit",
            "1" if name.startswith(("relative", "p", "metric", "region")) else "that of the metric",
        )
        columns.add(name, np.array([line[name] for line in lines]), role, unit, doc)
    return columns.table({"optimum": found.asked.metric, "base": found.base})


_FIELDS: Final = {
    "metric": "what it is about",
    "region": "number of points that cannot be told from the best one",
    "mean": "mean of the best point's fresh runs; _low and _high: its 95 % interval",
    "base": "mean of the base's fresh runs; _low and _high: its 95 % interval",
    "difference": "best point minus base, in fresh runs; low and high: its 95 % interval",
    "relative": "difference over the magnitude of the base's mean; _low and _high: the same of its interval",
    "pairs": "number of pairs of fresh runs with the same draws",
    "p": "probability of so large a difference by chance, two-sided",
}


def optimum_files(found: FoundOptimum) -> dict[str, bytes]:
    """The tables as files of a directory, by name, beside the Parquet file."""
    stream = io.BytesIO()
    csv.write_csv(optimum_table(found), stream)
    return {"optimum.csv": stream.getvalue(), "optimum.tex": optimum_latex(found).encode()}


# ---
# The figure: a map of the gain for each group, the region as a contour, and below it the costs.


#: Groups of one figure.
_MOST_DRAWN: Final = 9
_COLUMNS: Final = 3
_STAR: Final[dict[str, Any]] = {
    "marker": "*",
    "ms": 14,
    "color": BEST_COLOUR,
    "mec": "white",
    "lw": 0,
    "zorder": 4,
}


def optimum_figure(found: FoundOptimum) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of what was found; none where nothing was."""
    answers, asked = [each for each in found.answers if each.at][:_MOST_DRAWN], found.asked
    if not answers:
        return
    gains = [100 * (each.mean / each.base_mean - 1) * np.sign(each.base_mean) for each in answers]
    known = np.concatenate(gains)[np.isfinite(np.concatenate(gains))] * (
        1 if asked.side == "max" else -1
    )
    # Symmetric about 0; losses far beyond the best gain are cut off, as they would leave the gains pale.
    far = max(known.max(initial=0.0), 0.3 * np.abs(known).max(initial=1e-9))
    colours = ScalarMappable(
        Normalize(-far, far), GAIN_COLOUR_MAP if asked.side == "max" else f"{GAIN_COLOUR_MAP}_r"
    )
    columns = min(len(answers), _COLUMNS)
    lines = -(-len(answers) // columns)
    figure = blank(2.75 * columns + 1.1, 4.3 * lines + 1.0)
    grid = figure.subplots(
        2 * lines, columns, squeeze=False, gridspec_kw={"height_ratios": [3.0, 0.85] * lines}
    )
    maps, below = (grid[first::2].ravel()[: len(answers)] for first in (0, 1))
    for ax in {*grid.ravel()} - {*maps, *below}:
        ax.remove()
    across = [
        name for name, each in answers[0].points.items() if len(set(each.tolist())) > 1
    ] or list(answers[0].points)
    flat = len(across) > 1
    for i, (ax, answer, gain) in enumerate(zip(maps, answers, gains, strict=True)):
        x, *more = (_axis(found, name, answer.points[name]) for name in across[:2])
        here, inside = answer.judged.best, answer.judged.region
        if flat:
            shown_here = np.logical_and.reduce(
                [
                    np.full(len(gain), True),
                    *(answer.points[name] == answer.at[name] for name in across[2:]),
                ]
            )
            _draw_map(ax, [x, *more], gain, inside, shown_here, colours)
        else:
            order = np.argsort(x.values)
            ax.plot(x.values[order], gain[order], color=SERIES[0], lw=1.2, zorder=2)
            ax.scatter(
                x.values,
                gain,
                s=30,
                ec=SERIES[0],
                fc=np.where(inside, SERIES[0], "white"),
                zorder=3,
            )
            ax.axhline(0, color=MUTED_INK, lw=0.8)
        ax.plot(x.values[here], (more[0].values if flat else gain)[here], **_STAR, clip_on=False)
        set_scales(ax, x, more[0] if flat else None)
        _, share, ends = found.numbers(answer, asked.metric)
        place = ", ".join(found.text(key, value) for key, value in answer.at.items())
        ax.set_title(f"{share} {ends}\nat {place}", color=INK)
        head: dict[str, Any] = {"ha": "center", "fontweight": "bold", "color": INK}
        ax.annotate(
            found.called(answer), (0.5, 1), (0, 29), "axes fraction", "offset points", **head
        )
        ax.set(
            xlabel=x.label,
            ylabel=""
            if i % columns
            else more[0].label
            if flat
            else f"gain against {found.base} [%]",
        )
        ax.tick_params(labelleft=not (flat and i % columns))
    if flat:
        label = f"{spoken(asked.metric)} against {found.base} [%]"
        bar = colour_bar(figure, list(maps), colours, label, extend="both", shrink=0.9, aspect=26)
        bar.ax.yaxis.set_major_formatter(
            FuncFormatter(lambda value, _: signed(value).removesuffix(" %"))
        )
    _draw_costs(found, answers, list(below))
    frame: dict[str, Any] = (
        {"lw": 1.6, "color": INK} if flat else {"marker": "o", "lw": 0, "color": SERIES[0]}
    )
    handles = [
        Line2D([], [], label="best point", **_STAR),
        Line2D([], [], label="points that the data cannot tell from it", **frame),
    ]
    notes = [
        *found.how(),
        f"Map: mean of the runs that chose; {profile_text(profiles_of(found.results))}.",
    ]
    notes += (
        [f"Not shown: {', '.join(map(spoken, across[2:]))}, at their best."] if across[2:] else []
    )
    notes += (
        [f"{len(found.answers) - len(answers)} more are in the table."]
        if len(found.answers) > len(answers)
        else []
    )
    yield "optimum", around(figure, found.title, " ".join(notes), handles)


def _axis(found: FoundOptimum, name: str, values: np.ndarray) -> ShownValues:
    """A column of points as an axis; names stand at their places."""
    about = meta(found.results.schema.field(name))
    if about.get("scale") == "structure":
        names = tuple(dict.fromkeys(values.tolist()))
        return ShownValues(
            name, "", np.array([names.index(each) for each in values], float), names=names
        )
    return shown(name, about["unit"], values, log=about.get("scale") == "log")


def _draw_map(
    ax: Axes,
    axes: Sequence[ShownValues],
    gain: np.ndarray,
    region: np.ndarray,
    here: np.ndarray,
    look: ScalarMappable,
) -> None:
    """The gain of the points that are `here` (k,) as colours, and a line around the region."""
    x, y = (dataclasses.replace(each, values=each.values[here]) for each in axes)
    xs, ys = np.unique(x.values), np.unique(y.values)
    cells, inside = (
        cell_means(x.values, y.values, each[here] * 1.0, xs, ys) for each in (gain, region)
    )
    columns, rows = cell_edges(xs, x.log), cell_edges(ys, y.log)
    scale: Any = look.norm
    ax.set_facecolor(MISSING_COLOUR)
    ax.pcolormesh(columns, rows, np.ma.masked_invalid(cells.T), norm=scale, cmap=look.cmap)
    framed = np.pad(inside > 0, 1)
    upright, level = (
        zip(*np.nonzero(np.diff(each, axis=axis)), strict=True)
        for axis, each in enumerate((framed[:, 1:-1], framed[1:-1]))
    )
    sides = [(columns[[i, i]], rows[j : j + 2]) for i, j in upright] + [
        (columns[i : i + 2], rows[[j, j]]) for i, j in level
    ]
    for across, up in sides:
        ax.plot(across, up, color=INK, lw=1.8, solid_capstyle="round", clip_on=False)


def _draw_costs(
    found: FoundOptimum, answers: Sequence[OptimumAnswer], axes: Sequence[Axes]
) -> None:
    """Below each map what fresh runs say of the metric and both costs, relative to the base, on one scale."""
    lines = [[each.lines.get(name, {}) for name in found.metrics] for each in answers]
    ends = [
        abs(line.get(end, math.nan))
        for own in lines
        for line in own
        for end in ("relative_low", "relative_high")
    ]
    far = 115 * float(np.nanmax([*ends, 0.01]))
    for i, (ax, own) in enumerate(zip(axes, lines, strict=True)):
        ax.axvline(0, color=MUTED_INK, lw=0.8)
        for place, line in enumerate(own):
            if not math.isfinite(line.get("relative", math.nan)):
                continue
            low, middle, high = (
                100 * line[name] for name in ("relative_low", "relative", "relative_high")
            )
            colour, sure = SERIES[place], low > 0 or high < 0
            ax.plot([low, high], [place] * 2, color=colour, lw=2.2, solid_capstyle="butt")
            ax.plot(middle, place, "o", ms=5.5, color=colour, mfc=colour if sure else "white")
        ax.set_yticks(
            range(len(own)),
            [_SHORT.get(name, titled(name)) for name in found.metrics] if i == 0 else [],
        )
        ax.set(ylim=(len(own) - 0.5, -0.5), xlim=(-far, far), xlabel=f"against {found.base} [%]")
        ax.grid(axis="x", color=GRID, lw=0.8)
        ax.spines["left"].set_visible(False)
        ax.tick_params(axis="y", length=0, labelcolor=INK)


_SHORT: Final = {
    "cost_of_transport": "Mechanical cost",
    "electrical_cost_of_transport": "Electrical cost",
}
