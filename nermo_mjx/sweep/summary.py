"""summary.json: what a sweep's table says in numbers. SI units and radians, as in the table."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pyarrow as pa
from scipy import stats

from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sides import cost, sides_in
from nermo_mjx.sweep.table import columns_of, labelled

#: The metric whose dependence on each parameter is summed up.
LEADING = "speed"


def summarize(table: pa.Table | Results) -> dict[str, Any]:
    """The summary of a complete table; few of its columns are in memory at once."""
    results = table if isinstance(table, Results) else Results(table)
    well = results.well
    varied, metrics = columns_of(results, "varied"), columns_of(results, "metric")
    named = labelled(results)
    columns = results.columns(["variant", LEADING, *columns_of(results, "varied", "randomized")])
    variants = Variants.of(next(columns)[1], well)
    speed, correlations = next(columns)[1][well], {}
    for name, values in columns:
        if name not in named:
            correlations[name] = _correlation(values[well], speed)
        if name in varied:
            variants.values[name] = values[well][variants.first]
    spreads, best, sides = {}, {}, sides_in(results.schema)
    for name, values in results.columns([name for name in metrics if name not in ("fell", "diverged")]):
        spreads[name] = _spread(values[well])
        if name in sides:
            best[name] = _best(variants, values[well], sides[name])
    mean, _ = variants.means(speed)
    return {
        "rows": results.rows,
        "variants": variants.all,
        "repeats": results.rows // variants.all,
        "status": results.statuses,
        "metrics": spreads,
        "best": {name: best[name] for name in sides if name in best},
        "marginal_means": {name: _marginal(variants.values[name], mean) for name in varied} if results.is_grid else {},
        "rank_correlations": correlations,
        "spine_gain": _spine_gain(variants.values, mean) if results.is_grid else [],
    }


def spine_ratio(results: Results) -> dict[str, np.ndarray]:
    """How fast each variant walks relative to the stiff spine.

    Returns:
        One entry per variant with a successful run: the varied parameters, `ratio` (speed over the mean speed at
        amplitude 0, all but the spine's phase equal; nan without such a run), and `base` (that mean speed).
    """
    well = results.well
    columns = results.columns(["variant", LEADING, *columns_of(results, "varied")])
    variants = Variants.of(next(columns)[1], well)
    mean, _ = variants.means(next(columns)[1][well])
    values = {name: column[well][variants.first] for name, column in columns}
    ratio, base = _spine_ratio(values, mean)
    return {**values, "ratio": ratio, "base": base}


@dataclasses.dataclass(frozen=True)
class Variants:
    """The variants with a successful run.

    Attributes:
        all: the number of variants, those without such a run included.
        number: index of each, (variants,).
        first: its first run, by its place among those that went well, (variants,).
        count: its successful runs, (variants,).
        place: where the variant of each such run stands here, (runs,).
        values: the varied parameters, name -> (variants,).
    """

    all: int
    number: np.ndarray
    first: np.ndarray
    count: np.ndarray
    place: np.ndarray
    values: dict[str, np.ndarray] = dataclasses.field(default_factory=dict)

    @classmethod
    def of(cls, variant: np.ndarray, well: np.ndarray) -> Variants:
        """Of the variant of each run, (rows,), and whether it went well, (rows,)."""
        number, first, place, count = np.unique(variant[well], True, True, True)
        return cls(int(variant.max()) + 1, number, first, count, place)

    def means(self, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Mean and standard deviation of a metric over the repeats, (variants,) each, of its values (runs,)."""
        mean = np.bincount(self.place, values, len(self.number)) / self.count
        squares = np.bincount(self.place, (values - mean[self.place]) ** 2, len(self.number))
        return mean, np.sqrt(squares / np.maximum(self.count - 1, 1))


def _spread(values: np.ndarray) -> dict[str, float]:
    values = values[np.isfinite(values)]
    return {word: float(getattr(values, word)()) for word in ("mean", "std", "min", "max")} if len(values) else {}


def _best(variants: Variants, values: np.ndarray, side: str) -> dict[str, Any] | None:
    """The variant with the best mean over its repeats of a metric (runs,) with a better direction."""
    mean, std = variants.means(values)
    score = cost(side, mean)
    if not np.isfinite(score).any():
        return None
    at = int(np.nanargmin(score))
    return {
        "side": side,
        "variant": int(variants.number[at]),
        "mean": float(mean[at]),
        "std": float(std[at]),
        "runs": int(variants.count[at]),
        "parameters": _plain(variants.values, at),
    }


def _plain(values: Mapping[str, np.ndarray], at: int) -> dict[str, Any]:
    """The varied parameters and structures of a variant, as far as it has them."""
    parts = {name: column[at] for name, column in values.items()}
    return {name: each if isinstance(each, str) else float(each) for name, each in parts.items() if each == each}


def _marginal(parameter: np.ndarray, speed: np.ndarray) -> list[dict[str, Any]]:
    """Mean of the leading metric at each value of a parameter or structure, over everything else."""
    mean = ((value, float(np.nanmean(speed[parameter == value]))) for value in np.unique(parameter) if value == value)
    return [{"value": value if isinstance(value, str) else float(value), LEADING: each} for value, each in mean]


def _correlation(parameter: np.ndarray, speed: np.ndarray) -> float:
    """Spearman's rank correlation of two columns (runs,), where the first has a number."""
    parameter, speed = parameter[~np.isnan(parameter)], speed[~np.isnan(parameter)]
    constant = len(speed) < 3 or np.ptp(parameter) == 0 or np.ptp(speed) == 0
    return math.nan if constant else float(stats.spearmanr(parameter, speed).statistic)


def _spine_ratio(values: Mapping[str, np.ndarray], speed: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Speed over speed at amplitude 0, all but the spine's phase equal, and that speed at amplitude 0."""
    group = np.zeros(len(speed), int)  # a number for each group of equal rows
    for name, column in values.items():
        if name not in ("spine", "spine.amplitude", "spine.phase"):
            distinct, place = np.unique(column, return_inverse=True)
            group = np.unique(group * len(distinct) + place, return_inverse=True)[1]
    still = ~(values["spine.amplitude"] > 0) & np.isfinite(speed)  # a structure without it has no number
    groups = int(group.max(initial=-1)) + 1
    runs = np.bincount(group[still], minlength=groups)
    total = np.bincount(group[still], speed[still], groups)
    base = np.where(runs > 0, total / np.maximum(runs, 1), math.nan)[group]
    return speed / np.where(base > 0, base, math.nan), base


def _spine_gain(values: Mapping[str, np.ndarray], speed: np.ndarray) -> list[dict[str, Any]]:
    """Speed with the spine relative to the stiff spine; best and worst a frequency."""
    if "spine.amplitude" not in values:
        return []
    ratio, base = _spine_ratio(values, speed)
    ratio = np.where(values["spine.amplitude"] > 0, ratio, math.nan)
    lines = []
    for frequency in np.unique(values["frequency"]) if "frequency" in values else [None]:
        here = np.isfinite(ratio) & (True if frequency is None else values["frequency"] == frequency)
        line: dict[str, Any] = {} if frequency is None else {"frequency": float(frequency)}
        for word, pick in (("best", np.argmax), ("worst", np.argmin)):
            if here.any():
                at = int(np.flatnonzero(here)[pick(ratio[here])])
                parameters = {name: each for name, each in _plain(values, at).items() if name != "frequency"}
                line[word] = {
                    "ratio": float(ratio[at]),
                    "speed": float(speed[at]),
                    "speed_without": float(base[at]),
                    "parameters": parameters,
                }
        lines += [line] if here.any() else []
    return lines
