"""Two sets of runs compared: the difference of every metric with its interval, over all variants and by groups."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from scipy import stats

from nermo_mjx.robot.quantity import ParameterError, did_you_mean
from nermo_mjx.sweep.comparing.arms import Arm, Source, Value, two_tables, values_of, where
from nermo_mjx.sweep.comparing.bootstrap import RESAMPLES
from nermo_mjx.sweep.comparing.pairing import Differences, Pairing, differences, pair
from nermo_mjx.sweep.spec import OBJECTIVES
from nermo_mjx.sweep.table import LEADING, Columns, columns_of, meta

#: Share of false findings among those labelled beyond noise.
FALSE_SHARE: Final = 0.05
#: Number of variants whose mean says little about others.
FEW_VARIANTS: Final = 4
_NUMBERS: Final = {
    "base_mean": "mean of the base's variants",
    "other_mean": "mean of the other's variants",
    "difference": "other minus base, mean over the variants",
    "low": "lower end of the difference's 95 % confidence interval",
    "high": "upper end of it",
    "relative": "difference over the magnitude of the base's mean; none where that is not beyond its noise",
    "relative_low": "low over the same",
    "relative_high": "high over the same",
    "p": "probability of so large a difference by chance, two-sided",
}
_COUNTS: Final = {
    "variants": "common variants with a number on both sides",
    "runs_base": "runs of the base that count",
    "runs_other": "runs of the other that count",
    "failed_base": "runs of the base that fell or were lost",
    "failed_other": "runs of the other that fell or were lost",
}


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        table: one row per metric, group and other side: `other`, what it is compared with; the columns of the groups
            (null in the rows over all variants); `metric` and `metric_unit`; base_mean, other_mean, difference, low,
            high, relative, relative_low, relative_high, p, beyond_noise, better, variants, runs_base, runs_other,
            failed_base, failed_other. Each field's metadata has its description.
        base: what is compared with.
        others: what is compared with it; more than one if a column has more than two values.
        groups: the columns that make groups.
        drawn: the metrics of which figures and summaries have the groups.
        status: for each side, how often each status occurs in the common variants.
        notes: what is left out or averaged, in sentences.
    """

    table: pa.Table
    base: str
    others: tuple[str, ...]
    groups: tuple[str, ...]
    drawn: tuple[str, ...]
    status: Mapping[str, Mapping[str, int]]
    notes: tuple[str, ...]

    def rows(self, other: str, *, grouped: bool = False) -> list[dict[str, Any]]:
        """Rows of the table about one other side: those over all variants, or those of the groups."""
        group, about = pc.field("group"), pc.field("other")
        chosen = self.table.filter((about == other) & (group >= 0 if grouped else group < 0))
        return chosen.to_pylist()

    def about(self, only: Sequence[str] = ()) -> dict[str, Any]:
        """All of it for JSON: `metrics` by name; with groups, `groups`; with several others, `comparisons` of each.

        Args:
            only: metrics that the groups have; by default all.
        """
        each = [self._about(other, only) for other in self.others]
        about = {"base": self.base, "status": self.status, "notes": list(self.notes)}
        return about | (each[0] if len(each) == 1 else {"comparisons": each})

    def _about(self, other: str, only: Sequence[str]) -> dict[str, Any]:
        about: dict[str, Any] = {"other": other, "metrics": _by_metric(self.rows(other), self.groups)}
        if self.groups:
            grouped: dict[int, list[dict[str, Any]]] = {}
            for row in self.rows(other, grouped=True):
                if only and row["metric"] not in only:
                    continue
                grouped.setdefault(row["group"], []).append(row)
            about["groups"] = [{"for": {name: rows[0][name] for name in self.groups},
                                "metrics": _by_metric(rows, self.groups)} for rows in grouped.values()]  # fmt: skip
        return about


def compare(
    a: Source,
    b: Source | None = None,
    *,
    by: str | None = None,
    base: Value | None = None,
    groups: Sequence[str] = (),
    where: Mapping[str, Value] | None = None,
    drawn: Sequence[str] = (),
) -> Comparison:
    """Differences of every metric between two sweeps, or between two values of a column of one, with 95 % intervals.

    Runs are paired over the variants that both sides have, and over seeds where both have the same. A difference is
    the mean over the variants of the difference of their runs' means, B minus A, or other minus base. Intervals are
    of a two-stage bootstrap, of the variants and of the runs in each. `beyond_noise` is stricter than an interval
    without 0: it controls the share of false findings among all metrics, or among all groups of one metric, at 5 %, by
    Benjamini and Hochberg's procedure. Runs that fell or diverged count in the metrics `fell` and `diverged`, and are
    counted beside each of the others.

    >>> import tempfile
    >>> from nermo_mjx import run_sweep
    >>> spec = {"vary": {"frequency": [0.6, 0.8]}, "run": {"duration": 0.2}, "plots": False}
    >>> one, two = tempfile.mkdtemp(), tempfile.mkdtemp()
    >>> _ = run_sweep(spec, one, engine="c"), run_sweep(spec | {"physics": "fast"}, two, engine="c")
    >>> sorted(compare(one, two).about()["metrics"]["speed"])[:4]
    ['base_mean', 'better', 'beyond_noise', 'difference']

    Args:
        a: directory of a sweep, or its table.
        b: another one; without it, `by` says what is compared in `a`.
        by: a varied column, of which each value is compared with the base.
        base: the baseline value; by default `none`, if present, else the first.
        groups: varied columns: an additional interval for each combination of their values.
        where: varied columns and the value to which the runs are restricted.
        drawn: metrics of which figures and summaries have the groups; by default the speed.

    Raises:
        ParameterError: there is no such column or value, or no common variant.
        DirectoryError, SpecError: a directory holds no results, or cannot be read.
    """
    if (b is None) == (by is None):
        raise ParameterError("compare two directories, or with by two values of a column in one, and not both.")
    arms, notes = values_of(a, str(by), base) if b is None else two_tables(a, b)
    arms = [_restricted(arm, where or {}) for arm in arms]
    schemas = [columns_of(arm.results, "metric") for arm in arms]
    shared = [name for name in schemas[0] if all(name in known for known in schemas)]
    for name in drawn:
        if name not in shared:
            raise ParameterError(f"metric is {name!r}, which no table has or one lacks{did_you_mean(name, shared)}")
    drawn = drawn or ([LEADING] if LEADING in shared else shared[:1])
    lines: list[dict[str, Any]] = []
    status: dict[str, dict[str, int]] = {}
    for other in arms[1:]:
        pairing = pair(arms[0], other)
        notes += pairing.notes
        if 1 < pairing.variants <= FEW_VARIANTS and not groups:
            notes.append(f"The means are over {pairing.variants} variants only: their intervals are meant for variants "
                         "in general, and wide; groups have an interval for each variant.")  # fmt: skip
        for side in (pairing.base, pairing.other):
            status.setdefault(side.arm.name, _statuses(side.arm))
        lines += _lines(pairing, shared, ())
        lines += _lines(pairing, shared, groups) if groups else []
    if not any(math.isfinite(line["low"]) for line in lines):
        notes.append("No interval: each side has one run of one variant, which tells no noise; give repeats.")
    return Comparison(
        table=_table(lines, arms[0], by or "", groups, drawn),
        base=arms[0].name, others=tuple(arm.name for arm in arms[1:]), groups=tuple(groups), drawn=tuple(drawn),
        status=status, notes=tuple(dict.fromkeys(notes)),
    )  # fmt: skip


def better(field: pa.Field) -> str:
    """Whether high or low is better of a metric, or what is nearer to 0; empty if neither is."""
    known = {"max": "high", "min": "low", "nearest zero": "zero"}
    return meta(field).get("better") or known.get(OBJECTIVES.get(field.name, ""), "")


def _restricted(arm: Arm, chosen: Mapping[str, Value]) -> Arm:
    arm = where(arm, chosen)
    if not len(arm.rows):
        raise ParameterError(f"no run of {arm.name} is left with {', '.join(f'{k} = {v}' for k, v in chosen.items())}.")
    return arm


def _lines(pairing: Pairing, metrics: Sequence[str], groups: Sequence[str]) -> list[dict[str, Any]]:
    """Rows of the table about all variants, whose metrics form one family of tests, or about each group, where
    the tests of one metric form a family."""
    parts = list(pairing.groups(groups)) if groups else [({}, pairing)]
    lines = [{"other": pairing.other.arm.name, "group": place if groups else -1, **label, **line}
             for place, (label, part) in enumerate(parts)
             for line in _of_metrics(part, differences(part, metrics))]  # fmt: skip
    families = [[line for line in lines if line["metric"] == name] for name in metrics] if groups else [lines]
    for family in families:
        known = [line for line in family if math.isfinite(line["p"])]
        adjusted = stats.false_discovery_control([line["p"] for line in known]) if known else []
        for line, p in zip(known, adjusted, strict=True):
            line["beyond_noise"] = bool(p <= FALSE_SHARE)
    return lines


def _of_metrics(pairing: Pairing, found: Differences) -> Iterator[dict[str, Any]]:
    failed = [int((~side.arm.results.well[side.arm.rows]).sum()) for side in (pairing.base, pairing.other)]
    schema = pairing.base.arm.results.schema
    for i, name in enumerate(found.names):
        base, interval = float(found.base[i]), found.interval
        difference, low, high = (float(each[i]) for each in (interval.estimate, interval.low, interval.high))
        scale = abs(base) if found.known_base[i] else math.nan
        yield {
            "metric": name, "metric_unit": meta(schema.field(name))["unit"], "better": better(schema.field(name)),
            "base_mean": base, "other_mean": float(found.other[i]), "difference": difference, "low": low, "high": high,
            "relative": difference / scale, "relative_low": low / scale, "relative_high": high / scale,
            "p": float(interval.p[i]), "variants": int(found.variants[i]), "runs_base": int(found.runs_base[i]),
            "runs_other": int(found.runs_other[i]), "failed_base": failed[0], "failed_other": failed[1],
        }  # fmt: skip


def _table(
    lines: Sequence[Mapping[str, Any]], base: Arm, by: str, groups: Sequence[str], drawn: Sequence[str]
) -> pa.Table:
    """The lines as a table with described fields."""
    columns = Columns()

    def add(name: str, role: str, about: str, unit: str = "1", scale: str = "linear") -> None:
        columns.add(name, np.array([line.get(name) for line in lines]), role, unit, about, scale=scale)

    add("other", "index", "what is compared with the base")
    add("group", "index", "number of the group; -1: over all variants")
    for name in groups:
        known = meta(base.results.schema.field(name)) if name in base.results.schema.names else {}
        add(name, "varied", known.get("description", name), known.get("unit", "1"),
            scale=known.get("scale", "linear"))  # fmt: skip
    add("metric", "index", "which metric differs")
    add("metric_unit", "index", "unit of its means and of their difference")
    for name, about in _NUMBERS.items():
        add(name, "metric", about, "1" if name.startswith("relative") or name == "p" else "that of metric_unit")
    add("beyond_noise", "status", f"whether the difference is beyond noise: at most {FALSE_SHARE:.0%} of all such "
                                  "findings are false, by Benjamini and Hochberg")  # fmt: skip
    add("better", "index", "whether high or low is better, or what is nearer to zero; empty if none is")
    for name, about in _COUNTS.items():
        add(name, "metric", about)
    return columns.table({"comparison": base.name, "by": by, "drawn": " ".join(drawn), "resamples": RESAMPLES})


def _by_metric(rows: Sequence[Mapping[str, Any]], groups: Sequence[str]) -> dict[str, dict[str, Any]]:
    left_out = {"other", "group", "metric", *groups}
    return {row["metric"]: {("unit" if key == "metric_unit" else key): value for key, value in row.items()
                            if key not in left_out} for row in rows}  # fmt: skip


def _statuses(arm: Arm) -> dict[str, int]:
    names, counts = np.unique(arm.results.column("status")[arm.rows].astype(str), return_counts=True)
    return dict(zip(names.tolist(), counts.tolist(), strict=True))
