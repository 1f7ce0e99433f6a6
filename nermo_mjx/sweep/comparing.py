"""Two sets of runs compared, of two tables or of two values of a column in one: what is paired, with what intervals."""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, TypeAlias

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter
from scipy import stats

from nermo_mjx.plotting.charts import FigurePage, draw_horizontal_grid, set_scales
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.shown import ShownValues, shown, spoken, titled
from nermo_mjx.plotting.style import BEST_COLOUR, GRID, INK, LINE_COLOUR, MUTED_INK, SERIES
from nermo_mjx.robot.parameters import GAIT_CODES
from nermo_mjx.robot.quantity import ParameterError, Quantity, did_you_mean, of_type
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.runs.rows import part_files
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.sweep.counting import (
    NO_NUMBER,
    OF_ALL_RUNS,
    counts,
    losses,
    losses_text,
    matched,
    same_values,
    two_stage,
)
from nermo_mjx.sweep.spec import not_varied
from nermo_mjx.sweep.structures import label_of
from nermo_mjx.sweep.table import (
    LEADING,
    MAIN_METRICS,
    MAX_HELD_NUMBERS,
    Columns,
    Results,
    SweepRecord,
    better,
    columns_of,
    meta,
    profile_text,
    profiles_of,
    report_table,
)

if TYPE_CHECKING:
    import pandas as pd  # imported where it is used: it takes half a second

#: A directory of a sweep, or its table.
Source: TypeAlias = "str | os.PathLike[str] | pa.Table | Results"
Value: TypeAlias = "float | str"


@dataclasses.dataclass(frozen=True)
class Arm:
    """A set of runs.

    Attributes:
        name: as messages and tables call it.
        results: the table that holds them.
        runs: a line per run, whose index is its place in the table. Its columns distinguish variants: those that are
            varied, and values fixed instead; NaN or an empty text where a run has none. Where runs are paired, also
            `variant`, the common variant from 0, and `seed` of their random draws.
    """

    name: str
    results: Results
    runs: pd.DataFrame

    def where(self, selection: Any) -> Arm:
        """The runs where a mask (n,) holds."""
        return dataclasses.replace(self, runs=self.runs[np.asarray(selection)])


def opened_table(source: Source) -> tuple[str, Results, SweepRecord | None, list[str]]:
    """The name of a table, the table, what is known of its sweep, and notes on missing rows.

    Raises:
        DirectoryError: it holds no results, or they cannot be read.
    """
    if isinstance(source, Results | pa.Table):
        return "table", source if isinstance(source, Results) else Results(source), None, []
    out = Path(of_type("source", source, (str, os.PathLike), "a directory, or a table"))
    if not out.is_dir():
        raise SpecError(
            f"{out}: {'this is a file, not a directory' if out.exists() else 'no such directory'}."
        )
    files = part_files(out)
    if not files:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    results, sweep, notes = Results(files), SweepRecord.of_directory(out), []
    if sweep is not None and results.rows < sweep.rows:
        notes.append(f"{out} is not complete: {results.rows:,} of {sweep.rows:,} runs.")
    return str(source), results, sweep, notes


def two_tables(base: Source, other_source: Source) -> tuple[list[Arm], list[str]]:
    """All runs of two tables, and notes on how their sweeps differ."""
    arms, notes, sweeps = [], [], []
    for source in (base, other_source):
        name, results, sweep, incomplete = opened_table(source)
        arms.append(Arm(name, results, _runs_of(results)))
        sweeps.append(sweep)
        notes += incomplete
    if arms[0].name == arms[1].name:
        arms = [
            dataclasses.replace(arm, name=f"{arm.name} ({word})")
            for arm, word in zip(arms, "AB", strict=True)
        ]
    names = list(dict.fromkeys(name for arm in arms for name in arm.runs))
    for arm, sweep in zip(arms, sweeps, strict=True):
        for name in [
            name for name in names if name not in arm.runs
        ]:  # fixed by this sweep, if it has an effect
            value: Any = None
            if sweep is not None and name not in columns_of(arm.results, "randomized"):
                value = (
                    sweep.parameters[name]
                    if name in sweep.parameters
                    else label_of(sweep.fields.get(name))
                )
            arm.runs[name] = math.nan if value is None else value
    if all(sweeps):
        first, second = (
            {**sweep_fields.fields, **sweep_fields.fields["set"]}
            for sweep_fields in sweeps
            if sweep_fields is not None
        )
        varied = {
            "set",
            *names,
            *(
                name
                for sweep_fields in sweeps
                if sweep_fields is not None
                for name in sweep_fields.labelled
            ),
        }
        for name in {**first, **second}:
            if name not in varied and first.get(name) != second.get(name):
                values = (
                    "the default" if sweep_fields.get(name) is None else sweep_fields[name]
                    for sweep_fields in (first, second)
                )
                notes.append("They differ in {}: {} and {}.".format(name, *values))
    return arms, notes


def arms_of_values(source: Source, by: str, base: Value | None) -> tuple[list[Arm], list[str]]:
    """The runs of one table, split by a varied column; the base's come first.

    Raises:
        ParameterError: there is no such column, or it has no such value, or one value only.
    """
    _, results, _, notes = opened_table(source)
    runs = _runs_of(results)
    check_name(by, [*runs], "by")
    values = _values(runs[by])
    if len(values) < 2:
        raise ParameterError(
            f"by is {by!r}, which has the one value {value_text(values[0])}: nothing can be compared."
        )
    first = "none" if "none" in values else values[0]
    if base is not None:
        first = value_among(base, values, "base", results.schema.field(by))
    values = [first, *(value for value in values if value != first)]
    return [
        Arm(value_text(value), results, runs[runs[by] == value].drop(columns=by))
        for value in values
    ], notes


def _runs_of(results: Results) -> pd.DataFrame:
    """All runs of a table with their varied columns."""
    import pandas as pd

    columns: dict[str, Any] = {}
    for name, values in results.columns(columns_of(results, "varied")):
        text = values.dtype == object
        texts = ["" if cell is None else str(cell) for cell in values] if text else []
        columns[name] = np.array(texts, object) if text else same_values(values.astype(float))
    return pd.DataFrame(columns, index=range(results.rows))


def _absent(values: Any) -> Any:
    """Where a column, or each of several, has no value."""
    return values.isna() | (values == "")


def _values(column: pd.Series) -> list[Value]:
    """The different values of a column, in the order in which they come."""
    values: list[Value] = column[~_absent(column)].unique().tolist()
    return values


def check_name(name: str, allowed: Sequence[str], option: str) -> None:
    """Refuse a column that is not varied."""
    if name not in allowed:
        raise ParameterError(f"{option} is {name!r}, {not_varied(name, allowed)}")


def value_among(target: Value, values: Sequence[Value], option: str, column: pa.Field) -> Value:
    """The requested value, as in the column; numbers may differ in their last digits, and texts have units."""
    number = Quantity(
        0.0, meta(column).get("unit", "1"), -math.inf, math.inf, "of a column"
    ).number(str(target))
    number = math.nan if number is None else number
    for value in values:
        close = (
            value in (target, GAIT_CODES.get(str(target)))
            if isinstance(value, str)
            else math.isclose(number, value, abs_tol=1e-12)
        )
        if close:
            return value
    listed = ", ".join(map(value_text, values[:12])) + (
        f" and {len(values) - 12} more" if len(values) > 12 else ""
    )
    hint = did_you_mean(str(target), list(map(value_text, values)))
    raise ParameterError(f"{option} is {target!r}: the table has {listed}{hint or '.'}")


def value_text(value: Value) -> str:
    """A value of a column as text: none, 0.8."""
    return value if isinstance(value, str) else f"{value:.10g}"


# ---
# Which runs are compared with which: variants that both sides have, groups of them, and seeds that both share.


@dataclasses.dataclass(frozen=True)
class Pairing:
    """Two sides over common variants.

    A key that one side lacks, because nothing reads it there, does not distinguish variants: on the other side all its
    runs are averaged, or in groups by this key those of one value.

    Attributes:
        sides: the base's runs and the other's, with variants and seeds.
        values: the keys of the common variants, a line for each.
        alone: keys that one side has alone, and which one does, 0 or 1.
        notes: what is averaged or left out, in sentences.
    """

    sides: tuple[Arm, Arm]
    values: pd.DataFrame
    alone: Mapping[str, int]
    notes: tuple[str, ...]

    def groups(self, names: Sequence[str]) -> tuple[pd.DataFrame, list[pd.DataFrame]]:
        """The combinations of values of some keys, a line each, and both sides' runs with the column `group`.

        Of no keys, all runs are one group. A run may be in several, where the other side has a key alone.
        """
        import pandas as pd

        for name in names:
            check_name(name, [*self.values, *self.alone], "for")
        shared = ["all", *(name for name in names if name not in self.alone)]
        keys = self.values.assign(all=0)[shared]
        runs = []
        for side in self.sides:
            values = {name: keys[name].to_numpy()[side.runs["variant"]] for name in shared}
            runs.append(side.runs.assign(place=side.runs.index, **values))
        for side_index in (0, 1):
            if single_names := [name for name in names if self.alone.get(name) == side_index]:
                known_values = runs[side_index][
                    ~_absent(runs[side_index][single_names]).any(axis=1)
                ][[*shared, *single_names]].drop_duplicates()
                runs[1 - side_index] = (
                    runs[1 - side_index]
                    .drop(columns=single_names, errors="ignore")
                    .merge(known_values, on=shared)
                )
        all_runs = pd.concat([side_runs[["all", *names]] for side_runs in runs], ignore_index=True)
        code = _numbered(all_runs)
        parts = np.split(code, [len(runs[0])])
        common = np.intersect1d(parts[0], parts[1])
        labels = (
            all_runs.assign(code=code)
            .drop_duplicates("code")
            .set_index("code")
            .loc[common, list(names)]
        )
        numbered = zip((side_runs.set_index("place") for side_runs in runs), parts, strict=True)
        return labels, [
            side_runs[np.isin(part, common)].assign(
                group=np.searchsorted(common, part[np.isin(part, common)])
            )
            for side_runs, part in numbered
        ]


def pair(base: Arm, other_arm: Arm) -> Pairing:
    """Match the variants of two sides by their keys; what only one side has is left out.

    Raises:
        ParameterError: they have no variant in common.
    """
    import pandas as pd

    sides, notes, single_side = (base, other_arm), list[str](), dict[str, int]()
    keys = pd.concat(
        [base.runs, other_arm.runs], ignore_index=True
    )  # NaN in a column that a side lacks
    for name in keys.select_dtypes("number"):
        keys[name] = same_values(keys[name].to_numpy())
    split, absent = len(base.runs), _absent(keys)
    for name in list(keys):
        lacking = [bool(absent[name][:split].all()), bool(absent[name][split:].all())]
        if any(lacking):
            del keys[name]
            if not all(lacking):
                single_side[name] = lacking.index(False)
                side_name = sides[single_side[name]].name
                notes.append(
                    f"{name} varies in {side_name} alone, and is averaged there, but for groups by it."
                )
    code = _numbered(keys)
    common = np.intersect1d(code[:split], code[split:])
    if not len(common):
        raise ParameterError(
            f"{base.name} and {other_arm.name} have no variant in common: {_first_apart(base, other_arm)}"
        )
    has_seeds = all("seed" in arm.results.schema.names for arm in sides)
    paired = []
    for i, (arm, side_codes) in enumerate(zip(sides, (code[:split], code[split:]), strict=True)):
        is_common = np.isin(side_codes, common)
        if not is_common.all():
            left_count = len(np.unique(side_codes[~is_common]))
            notes.append(
                f"{left_count:,} variants are in {arm.name} alone, and left out ({int((~is_common).sum()):,} runs)."
            )
        seed = arm.results.column("seed")[arm.runs.index] if has_seeds else 2 * arm.runs.index + i
        runs = arm.runs.assign(variant=np.searchsorted(common, side_codes), seed=seed)
        paired.append(dataclasses.replace(arm, runs=runs).where(is_common))
    first = np.unique(code, return_index=True)[1][np.isin(np.unique(code), common)]
    return Pairing((paired[0], paired[1]), keys.iloc[first], single_side, tuple(notes))


def _numbered(keys: pd.DataFrame) -> np.ndarray:
    """A number for each combination of keys, (n,): numbers by their order, names in the order in which they come."""
    import pandas as pd

    label = np.zeros(len(keys), int)
    for name in keys:
        text = not pd.api.types.is_numeric_dtype(keys[name])
        code = pd.factorize(keys[name], sort=not text, use_na_sentinel=False)[0]
        label = np.unique(label * (code.max(initial=0) + 1) + code, return_inverse=True)[1]
    return label


# Long because each column of the table is one statement.
def difference_rows(
    pairing: Pairing,
    groups: Sequence[str],
    metrics: Sequence[str],
    progress: Callable[[float], None],
) -> Iterator[dict[str, Any]]:
    """The rows of the table about each combination of the groups' values, and each metric."""
    import pandas as pd

    labels, runs = pairing.groups(groups)
    variants, sides = len(pairing.values), pairing.sides
    parts, group = len(labels), [side_runs["group"].to_numpy() for side_runs in runs]
    index = [
        pd.MultiIndex.from_arrays(
            [side_runs["group"] * variants + side_runs["variant"], side_runs["seed"]]
        )
        for side_runs in runs
    ]
    well = [side.results.well[side_runs.index] for side, side_runs in zip(sides, runs, strict=True)]
    schema, numbers_by_metric = sides[0].results.schema, dict[str, dict[str, np.ndarray]]()

    def of_parts(masks: Sequence[np.ndarray]) -> list[np.ndarray]:
        """How many of each side's runs (n,) are in each part."""
        return [
            np.bincount(side_group[here], minlength=parts)
            for side_group, here in zip(group, masks, strict=True)
        ]

    at_once = max(1, MAX_HELD_NUMBERS // max(sum(map(len, runs)), 1))
    for start in range(0, len(metrics), at_once):
        progress(start / len(metrics))
        frames = [
            pd.DataFrame(
                {
                    name: column[side_runs.index]
                    for name, column in side.results.columns(metrics[start:][:at_once])
                }
            )
            for side, side_runs in zip(sides, runs, strict=True)
        ]
        alike: dict[
            bytes, tuple[list[np.ndarray], list[str]]
        ] = {}  # metrics of which the same runs have a number
        for name in frames[0]:
            masks = [
                counts(name, frame[name].to_numpy(), good)
                for frame, good in zip(frames, well, strict=True)
            ]
            alike.setdefault(b"".join(row_mask.tobytes() for row_mask in masks), (masks, []))[
                1
            ].append(name)
        for masks, few in alike.values():
            values, paired = matched(
                [
                    frame[few].set_index(side_runs)
                    for frame, side_runs in zip(frames, index, strict=True)
                ],
                masks,
            )
            numbers_of, several = _measured(values, paired, variants, parts)
            pairs = np.bincount(
                values[0].index.unique(0).intersection(paired) // variants, minlength=parts
            )
            used = of_parts(
                [
                    side_runs.isin(row_mask.index) & mask
                    for side_runs, row_mask, mask in zip(index, values, masks, strict=True)
                ]
            )
            good = of_parts(masks)
            left_out = good[0] + good[1] - used[0] - used[1]
            whole = several, pairs, left_out, *used, *of_parts([~row_mask for row_mask in well])
            lost = [
                1 - side_runs / np.bincount(row_mask)
                for side_runs, row_mask in zip(good, group, strict=True)
            ]
            for i, name in enumerate(few):
                line = {key: numbers[:, i] for key, numbers in numbers_of.items()}
                if name in OF_ALL_RUNS:  # yes or no: no surer than the exact test of signs
                    least = 2.0 ** (1 - np.minimum(*used))
                    alike_all = (line["p"] < least) & (line["low"] == line["high"])
                    line |= {key: np.where(alike_all, np.nan, line[key]) for key in ("low", "high")}
                    line["p"] = np.maximum(line["p"], least)
                numbers_by_metric[name] = line | dict(
                    zip(_COUNT_MEANINGS, (*whole, *lost), strict=True)
                )
    for part_index in range(parts):
        label = {key: column.iloc[[part_index]].item() for key, column in labels.items()}
        for name in metrics:
            field, row = (
                schema.field(name),
                {
                    key: numbers[part_index].item()
                    for key, numbers in numbers_by_metric[name].items()
                },
            )
            line_start = {
                "metric": name,
                "metric_unit": meta(field)["unit"],
                "better": better(field),
            }
            yield {"group": part_index if groups else -1, **label, **line_start, **row}


def _measured(
    sides: Sequence[pd.DataFrame], paired: pd.Index, variants: int, parts: int
) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The `_NUMBERS` of each part and metric, (parts, m), and how many variants each part has, (parts,)."""
    numbers = {name: np.full((parts, sides[0].shape[1]), np.nan) for name in _NUMBERS}
    units = sides[0].index.unique(0)
    several = np.bincount(units // variants, minlength=parts)
    if not len(units):
        return numbers, several
    present, group = np.unique(units // variants, return_inverse=True)
    unit = [units.get_indexer(side_means.index.get_level_values(0)) for side_means in sides]
    pairs = [side_means.index.isin(paired, level=0) for side_means in sides]
    first, second = (side_means.to_numpy() for side_means in sides)
    values = np.concatenate(
        [second[pairs[1]] - first[pairs[0]], -first[~pairs[0]], second[~pairs[1]]]
    )
    cells = [
        unit[0][pairs[0]],
        len(units) + unit[0][~pairs[0]],
        2 * len(units) + unit[1][~pairs[1]],
    ]
    cell, cell_index = np.unique(np.concatenate(cells), return_inverse=True)
    observed = np.concatenate([first, second])
    observed[:, sides[0].columns.isin(OF_ALL_RUNS)] = 0.0  # they have a rule of their own
    interval = two_stage(values, cell_index, cell % len(units), group, observed)
    means = [
        side_means.groupby(level=0).mean().groupby(group).mean().to_numpy() for side_means in sides
    ]
    # Where the base's mean is nothing but noise, no share of it says anything.
    of_base = sides[0].groupby(group[unit[0]])
    noise = 2 * (of_base.std(ddof=0) / np.sqrt(of_base.count())).to_numpy()
    scale = np.where(np.abs(means[0]) > noise, np.abs(means[0]), np.nan)
    relative = (bound / scale for bound in interval[:3])
    for into, part in zip(
        numbers.values(), (*means, *interval[:3], *relative, interval.p), strict=True
    ):
        into[present] = part
    return numbers, several


def _first_apart(base: Arm, other_arm: Arm) -> str:
    """The first key of which they share no value, in words."""
    for name in base.runs:
        values = [sorted(_values(arm.runs[name])) for arm in (base, other_arm) if name in arm.runs]
        if len(values) == 2 and all(values) and not set(values[0]) & set(values[1]):
            first, second = (
                ", ".join(map(value_text, side_values[:4])) + ", ..." * (len(side_values) > 4)
                for side_values in values
            )
            return f"{name} is {first} in the one and {second} in the other."
    return "each combination of values is in one of them alone."


# ---
# Two sets of runs compared: the difference of every metric with its interval, over all variants and by groups.


#: What a comparison is of, if not of metrics that are named: what is gained, and at what cost.
GAINS: Final = (LEADING, "cost_of_transport", "electrical_cost_of_transport")
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
_COUNT_MEANINGS: Final = {
    "variants": "common variants with a number on both sides",
    "paired": "those of them whose runs are pairs, by their seeds",
    "left_out": "runs of both that would count, but whose partner of the same seed is lost, or not there",
    "runs_base": "runs of the base that count",
    "runs_other": "runs of the other that count",
    "failed_base": "runs of the base that did not end well",
    "failed_other": "runs of the other that did not end well",
    "lost_base": "share of the base's runs that is lost: it did not end well, or has no number",
    "lost_other": "share of the other's runs that is lost",
}


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The result of `compare`.

    Attributes:
        table: one row per metric, group and other side: `other`, what it is compared with; the columns of the groups
            (null in the rows over all variants); `metric` and `metric_unit`; base_mean, other_mean, difference, low,
            high, relative, relative_low, relative_high, p, beyond_noise, better, variants, paired, left_out,
            runs_base, runs_other, failed_base, failed_other, lost_base, lost_other. Each field's metadata has its
            description.
        base: what is compared with.
        profiles: those of the walks, on which every difference depends.
        others: what is compared with it; more than one if a column has more than two values.
        groups: the columns that make groups.
        drawn: the metrics of which figures and summaries have the groups.
        status: for each side, how often each status occurs in the common variants.
        notes: what is left out or averaged, in sentences; first `lost`.
        lost: where the sides lost different shares of their runs, in sentences.
    """

    table: pa.Table
    base: str
    profiles: tuple[str, ...]
    others: tuple[str, ...]
    groups: tuple[str, ...]
    drawn: tuple[str, ...]
    status: Mapping[str, Mapping[str, int]]
    notes: tuple[str, ...]
    lost: tuple[str, ...]

    def rows(self, other_name: str, *, grouped: bool = False) -> list[dict[str, Any]]:
        """Rows of the table about one other side: those over all variants, or those of the groups."""
        group, other_field = pc.field("group"), pc.field("other")
        selected = self.table.filter(
            (other_field == other_name) & (group >= 0 if grouped else group < 0)
        )
        return selected.to_pylist()

    def about(self, only: Sequence[str] = ()) -> dict[str, Any]:
        """All of it for JSON: `metrics` by name; with groups, `groups`; with several others, `comparisons` of each.

        Args:
            only: metrics that the groups have; by default all.
        """
        pairs = []
        for other_name in self.others:
            pair_fields: dict[str, Any] = {
                "other": other_name,
                "metrics": _by_metric(self.rows(other_name), self.groups),
            }
            rows = [
                row
                for row in self.rows(other_name, grouped=True)
                if not only or row["metric"] in only
            ]
            if self.groups:
                pair_fields["groups"] = [
                    {
                        "for": {name: pair_row[0][name] for name in self.groups},
                        "metrics": _by_metric(pair_row, self.groups),
                    }
                    for pair_row in (
                        list(pair_row)
                        for _, pair_row in itertools.groupby(rows, lambda row: row["group"])
                    )
                ]
            pairs.append(pair_fields)
        pair_fields = {
            "base": self.base,
            "profiles": list(self.profiles),
            "status": self.status,
            "notes": list(self.notes),
        }
        return pair_fields | (pairs[0] if len(pairs) == 1 else {"comparisons": pairs})


# Long because one comparison passes from the tables to the report.
def compare(
    a: Source,
    b: Source | None = None,
    *,
    by: str | None = None,
    base: Value | None = None,
    groups: Sequence[str] = (),
    where: Mapping[str, Value] | None = None,
    drawn: Sequence[str] = (),
    progress: Callable[[float], None] = lambda _: None,
) -> Comparison:
    """Differences of every metric between two sweeps, or between two values of a column of one, with 95 % intervals.

    Runs are paired by variant and seed, metric by metric: where a run is lost, its partner is left out, too. Only in
    variants without a common seed each side has its own runs. A difference is the mean over the variants of the
    difference of their runs' means, B minus A, or other minus base. Intervals and p-values are of Student's t, over the
    variants' differences, or over the runs of a single variant, see `nermo_mjx.sweep.counting`. `beyond_noise` is
    stricter than an interval without 0: it controls the share of false findings among all metrics, or among all groups
    of one metric, at 5 %, by Benjamini and Hochberg's procedure. Runs that did not end well count in the metrics `fell`
    and `diverged` alone; beside each of the others stands the share that was lost.

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
        drawn: metrics of which figures and summaries have the groups; by default the speed and both costs of transport.
        progress: called with the share done, in [0, 1].

    Raises:
        ParameterError: there is no such column or value, or no common variant.
        DirectoryError, SpecError: a directory holds no results, or cannot be read.
    """
    if (b is None) == (by is None):
        raise ParameterError(
            "compare two directories, or with by two values of a column in one, and not both."
        )
    arms, notes = arms_of_values(a, str(by), base) if b is None else two_tables(a, b)
    for i, arm in enumerate(arms):
        for name, condition in (where or {}).items():
            check_name(name, [*arm.runs], "where")
            selected_value = value_among(
                condition, _values(arm.runs[name]), f"where {name}", arm.results.schema.field(name)
            )
            arm = arm.where(arm.runs[name] == selected_value)
        if not len(arm.runs):
            values = ", ".join(f"{name} = {value}" for name, value in (where or {}).items())
            raise ParameterError(f"no run of {arm.name} is left with {values}.")
        arms[i] = arm
    schemas = [columns_of(arm.results, "metric") for arm in arms]
    profiles = dict.fromkeys(name for arm in arms for name in profiles_of(arm.results))
    if "profile" in (where or {}):
        profiles = dict.fromkeys(name for arm in arms for name in arm.runs["profile"])
    shared = [name for name in schemas[0] if all(name in schema_names for schema_names in schemas)]
    for name in drawn:
        if name not in shared:
            raise ParameterError(
                f"metric is {name!r}, which no table has or one lacks{did_you_mean(name, shared)}"
            )
    drawn = drawn or [name for name in GAINS if name in shared] or shared[:1]
    lines, lost, unpaired = list[dict[str, Any]](), list[str](), list[str]()
    status: dict[str, dict[str, int]] = {}
    parts: list[Sequence[str]] = [(), groups] if groups else [()]
    done = 0

    def report(share: float) -> None:
        progress((done + share) / (len(parts) * (len(arms) - 1)))

    for other_arm in arms[1:]:
        pairing = pair(arms[0], other_arm)
        notes += pairing.notes
        variants = len(pairing.values)
        if 1 < variants <= FEW_VARIANTS and not groups:
            notes.append(
                f"The means are over {variants} variants only: their intervals are meant for variants in general, by "
                f"Student's t with {variants - 1} degree{'s' * (variants > 2)} of freedom, and wide; groups have an "
                "interval for each variant."
            )
        for side in pairing.sides:
            statuses = collections.Counter(side.results.column("status")[side.runs.index].tolist())
            status.setdefault(side.name, dict(sorted(statuses.items())))
        for names in parts:
            arm_lines = _lines(pairing, shared, names, report)
            done += 1
            lines += arm_lines
            if not names:
                lost += _lost(pairing, [line for line in arm_lines if line["metric"] in drawn])
                unpaired += (
                    unpaired_metric
                    for line in arm_lines
                    if line["metric"] in drawn[:1]
                    for unpaired_metric in _unpaired(pairing, line)
                )
    if not any(math.isfinite(line["low"]) for line in lines):
        notes.append(
            "No interval: each side has one run of one variant, which tells no noise; give repeats."
        )
    return Comparison(
        table=_table(lines, arms[0], by or "", groups, {"drawn": drawn, "profile": list(profiles)}),
        base=arms[0].name,
        profiles=tuple(profiles),
        others=tuple(arm.name for arm in arms[1:]),
        groups=tuple(groups),
        drawn=tuple(drawn),
        status=status,
        notes=tuple(dict.fromkeys([*lost, *notes, *unpaired])),
        lost=tuple(dict.fromkeys(lost)),
    )


def _lost(pairing: Pairing, lines: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    """Where the sides lost different shares of their runs, a sentence on the metrics that lost the same ones."""
    arms_by_reason = dict[tuple[Any, ...], list[str]]()
    for line in lines:
        words = [(line[f"lost_{side}"], line[f"failed_{side}"]) for side in ("base", "other")]
        arms_by_reason.setdefault(tuple(words), []).append(spoken(line["metric"]))
    for (base, other_arm), names in arms_by_reason.items():
        arm_names, table = list[str](), list[tuple[int, int]]()
        for side, (share, failed) in zip(pairing.sides, (base, other_arm), strict=True):
            index, runs = side.runs.index, len(side.runs)
            why, lost_text = (
                losses(side.results.column("status")[index], side.results.well[index]),
                round(share * runs),
            )
            why |= {NO_NUMBER: lost_text - failed} if lost_text > failed else {}
            arm_names.append(f"{lost_text:,} of {runs:,} runs of {side.name}{losses_text(why)}")
            table.append((lost_text, runs - lost_text))
        if base[0] != other_arm[0]:
            yield (
                f"Lost for {', '.join(names)}: {' and '.join(arm_names)} (p {stats.fisher_exact(table).pvalue:.2g} by "
                "Fisher's exact test); what is left on the two sides may not be the same robots."
            )


def _unpaired(pairing: Pairing, line: Mapping[str, Any]) -> Iterator[str]:
    """What is not paired, of the metric of a row over all variants."""
    names = " and ".join(side.name for side in pairing.sides)
    if line["left_out"]:
        yield f"Left out, because the run of the same seed is lost or not there: {line['left_out']:,}, of {names}."
    if apart := line["variants"] - line["paired"]:
        yield f"Not paired: {apart:,} of {line['variants']:,} variants of {names} have no seed in common."


def _lines(
    pairing: Pairing,
    metrics: Sequence[str],
    groups: Sequence[str],
    progress: Callable[[float], None],
) -> list[dict[str, Any]]:
    """Rows of the table about all variants, whose metrics form one family of tests, or about each group, where
    the tests of one metric form a family."""
    rows = difference_rows(pairing, groups, metrics, progress)
    lines: list[dict[str, Any]] = [{"other": pairing.sides[1].name, **line} for line in rows]
    families = (
        [[line for line in lines if line["metric"] == name] for name in metrics]
        if groups
        else [lines]
    )
    for family in families:
        tested = [line for line in family if math.isfinite(line["p"])]
        adjusted = stats.false_discovery_control([line["p"] for line in tested]) if tested else []
        for line, p in zip(tested, adjusted, strict=True):
            line["beyond_noise"] = bool(p <= FALSE_SHARE)
    return lines


def _table(
    lines: Sequence[Mapping[str, Any]],
    base: Arm,
    by: str,
    groups: Sequence[str],
    label_columns: Mapping[str, Sequence[str]],
) -> pa.Table:
    """The lines as a table with described fields; its metadata have what is named."""
    columns = Columns()

    def add(name: str, role: str, description: str, unit: str = "1", scale: str = "linear") -> None:
        columns.add(
            name, np.array([line.get(name) for line in lines]), role, unit, description, scale=scale
        )

    add("other", "index", "what is compared with the base")
    add("group", "index", "number of the group; -1: over all variants")
    for name in groups:
        metadata = (
            meta(base.results.schema.field(name)) if name in base.results.schema.names else {}
        )
        add(
            name,
            "varied",
            metadata.get("description", name),
            metadata.get("unit", "1"),
            scale=metadata.get("scale", "linear"),
        )
    add("metric", "index", "which metric differs")
    add("metric_unit", "index", "unit of its means and of their difference")
    for name, description in _NUMBERS.items():
        add(
            name,
            "metric",
            description,
            "1" if name.startswith("relative") or name == "p" else "that of metric_unit",
        )
    add(
        "beyond_noise",
        "status",
        f"whether the difference is beyond noise: at most {FALSE_SHARE:.0%} of all such "
        "findings are false, by Benjamini and Hochberg",
    )
    add(
        "better",
        "index",
        "whether high or low is better, or what is nearer to zero; empty if none is",
    )
    for name, description in _COUNT_MEANINGS.items():
        add(name, "metric", description)
    words = {key: " ".join(names) for key, names in label_columns.items()}
    return columns.table({"comparison": base.name, "by": by, **words})


def _by_metric(
    rows: Sequence[Mapping[str, Any]], groups: Sequence[str]
) -> dict[str, dict[str, Any]]:
    left_out, called = {"other", "group", "metric", *groups}, {"metric_unit": "unit"}
    return {
        row["metric"]: {
            called.get(key, key): value for key, value in row.items() if key not in left_out
        }
        for row in rows
    }


# ---
# Figures of a comparison, from its table alone: differences by metric, and the gain of one metric by groups.


Row = Mapping[str, Any]
#: Metrics of one figure, and panels.
_MOST_METRICS: Final = 30
_MAX_COMPARISON_PANELS: Final = 12
_COLUMNS: Final = 3
#: Relative differences beyond this are cut off in the figure, if there are others [fraction].
_FAR: Final = 1.0
_MARKS: Final = "filled: beyond noise; hollow: within it; bars: 95 % intervals"


def figures_of_comparison(table: pa.Table) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a comparison's table, for each other side; by groups, of the metrics that it names."""
    metadata = table.schema.metadata or {}
    base, metrics = metadata[b"comparison"].decode(), metadata[b"drawn"].decode().split()
    groups = columns_of(table, "varied")
    profile = profile_text(profiles_of(table))
    lines = table.to_pylist()
    for other_name in dict.fromkeys(line["other"] for line in lines):
        arm_lines = [line for line in lines if line["other"] == other_name]
        # Directories may have long names, and one figure is of two values of a column at most.
        by = metadata.get(b"by", b"").decode()
        against = (
            f"{spoken(by)} {_text(other_name)} against {_text(base)}"
            if by
            else f"{_last(other_name)} against {_last(base)}"
        )
        tail = "" if len({line["other"] for line in lines}) == 1 else f"-{_last(other_name)}"
        yield (
            f"differences{tail}",
            _forest([line for line in arm_lines if line["group"] < 0], against, profile),
        )
        if groups:
            rows = [line for line in arm_lines if line["group"] >= 0 and line["metric"] in metrics]
            figure_name = f"{metrics[0]}-gain" if len(metrics) == 1 else "gains"
            figure = _by_groups(rows, metrics, table.schema, groups, against, profile)
            yield f"{figure_name}-by-{'-and-'.join(groups)}{tail}", figure


def comparison_figures(out: Path) -> Figures:
    """The figures of a comparison's directory.

    Raises:
        DirectoryError: its table is absent or damaged.
    """
    return figures_of_comparison(report_table(out, "comparison"))


# Long because one figure is laid out from top to bottom.
def _forest(rows: Sequence[Row], against: str, profile: str) -> Figure:
    """The relative difference of each metric with its interval, and in numbers beside it."""
    finite_rows = [
        row for row in rows if row["relative"] is not None and np.isfinite(row["relative"])
    ]
    listed = [
        row for row in finite_rows if row["metric"] in MAIN_METRICS or row["beyond_noise"]
    ] or finite_rows
    order = {name: rank for rank, name in enumerate(MAIN_METRICS)}
    shown_rows = sorted(
        listed, key=lambda row: (not row["better"], order.get(row["metric"], len(order)))
    )[:_MOST_METRICS]
    page = FigurePage(f"Relative differences: {against}", (7.6, 0.24 * len(shown_rows) + 1.5))
    ax = page.axes[0, 0]
    # An outlier would leave the others no room.
    ends = np.abs(
        [[row["relative_low"], row["relative_high"]] for row in shown_rows] or [[0.1, 0.1]]
    )
    far = float(min(max(1.12 * np.nanmax(ends, initial=0.02), 0.02), _FAR))
    ax.axvline(0, color=MUTED_INK, lw=0.8)
    for rank, row in enumerate(shown_rows):
        low, middle, high = (
            float(row[name]) for name in ("relative_low", "relative", "relative_high")
        )
        closer = abs(row["other_mean"]) < abs(row["base_mean"])
        gains = {"high": middle > 0, "low": middle < 0, "zero": closer}.get(row["better"])
        colour = (
            MUTED_INK
            if gains is None or not row["difference"]
            else LINE_COLOUR
            if gains
            else BEST_COLOUR
        )
        ax.plot(
            np.clip([low, high], -far, far),
            [rank, rank],
            color=colour,
            lw=1.4,
            solid_capstyle="butt",
        )
        out = abs(middle) > far
        ax.plot(
            np.clip(middle, -far, far),
            rank,
            marker=("<" if middle < 0 else ">") if out else "o",
            ms=5.5,
            color=colour,
            mfc=colour if row["beyond_noise"] else "white",
            clip_on=False,
        )
        interval = "no interval" if np.isnan(low) else f"[{_percent(low)}, {_percent(high)}]"
        ax.text(
            1.02,
            rank,
            f"{_percent(middle)} %  {interval}",
            transform=ax.get_yaxis_transform(),
            va="center",
            fontsize=8,
            color=INK if row["beyond_noise"] else MUTED_INK,
        )
    ax.set_yticks(range(len(shown_rows)), [titled(row["metric"]) for row in shown_rows])
    ax.set(
        ylim=(len(shown_rows) - 0.4, -0.6),
        xlim=(-far, far),
        xlabel="difference relative to the base's mean [%]",
    )
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _percent(value)))
    ax.grid(axis="x", color=GRID, lw=0.8)
    hidden_count = len(rows) - len(shown_rows)
    hidden_note = f"\n{hidden_count} more metrics are in the table" if hidden_count else ""
    handles = [
        _mark(LINE_COLOUR, "better"),
        _mark(BEST_COLOUR, "worse"),
        _mark(MUTED_INK, "neither"),
    ]
    return page.finish(handles, f"{_MARKS}\n{profile}; {_runs(rows)}{hidden_note}")


# Long because one figure is laid out from top to bottom.
def _by_groups(
    rows: Sequence[Row],
    metrics: Sequence[str],
    schema: pa.Schema,
    groups: Sequence[str],
    against: str,
    profile: str,
) -> Figure:
    """The gain of each metric over the groups: one of their columns across, one as lines, the others as panels."""
    # The x axis is the numbers with the most values, the lines are the names or numbers with the most of the few.
    count = {name: len({row[name] for row in rows}) for name in groups}
    numeric = [name for name in groups if all(isinstance(row[name], float) for row in rows)]
    x = max(numeric or groups, key=count.__getitem__)
    few = [name for name in groups if name != x and count[name] <= len(SERIES)]
    series = max(few, key=count.__getitem__) if few else None
    panels = [name for name in groups if name not in (x, series)]
    parts = list(dict.fromkeys(tuple(row[name] for name in panels) for row in rows))[
        :_MAX_COMPARISON_PANELS
    ]
    series_values = list(dict.fromkeys(row[series] if series else None for row in rows))
    # A row of panels has all metrics; of one metric, its panels follow one another.
    panel_cells = [(part, metric) for part in parts for metric in metrics]
    columns = min(len(metrics) if len(metrics) > 1 else len(parts), _COLUMNS)
    lines = -(-len(panel_cells) // columns)
    page = FigurePage(
        f"{titled(metrics[0]) if len(metrics) == 1 else 'Speed and costs of transport'}: {against}",
        (max(6.4, 3.3 * columns), 3.0 * lines + 1.0),
        lines,
        columns,
    )
    for ax in page.axes.ravel()[len(panel_cells) :]:
        ax.remove()
    for number, (ax, (part, metric)) in enumerate(
        zip(page.axes.ravel(), panel_cells, strict=False)
    ):
        of_metric = [row for row in rows if row["metric"] == metric]
        panel_rows = [row for row in of_metric if tuple(row[name] for name in panels) == part]
        relative = all(
            row["relative"] is not None and np.isfinite(row["relative"]) for row in of_metric
        )
        names = (
            ("relative", "relative_low", "relative_high")
            if relative
            else ("difference", "low", "high")
        )
        numbers = shown(
            metric,
            panel_rows[0]["metric_unit"],
            [[row[name] for name in names] for row in panel_rows],
        )
        values = (
            100 * np.array([[row[name] for name in names] for row in panel_rows], float)
            if relative
            else numbers.values
        )
        places = [row[x] for row in panel_rows]
        if all(isinstance(value, float) for value in places):
            metadata = meta(schema.field(x))
            across = shown(x, metadata["unit"], places, log=metadata.get("scale") == "log")
        else:
            texts = list(map(_text, places))
            names_of = tuple(dict.fromkeys(texts))
            across = ShownValues(
                x, "", np.array([names_of.index(text) for text in texts], float), names=names_of
            )
        distinct = np.unique(across.values)
        step = float(np.diff(distinct).min()) if len(distinct) > 1 else 1.0
        for series_index, value in enumerate(series_values):
            series_rows = np.array(
                [i for i, row in enumerate(panel_rows) if series is None or row[series] == value],
                int,
            )
            order = series_rows[np.argsort(across.values[series_rows], kind="stable")]
            # Lines stand a little apart, so that their bars do not cover each other.
            shift = (
                0.0 if across.log else (series_index - (len(series_values) - 1) / 2) * 0.09 * step
            )
            positions, colour = across.values[order] + shift, SERIES[series_index % len(SERIES)]
            middle, low, high = values[order].T
            ax.plot(
                positions, middle, color=colour, lw=0 if across.names else 1.2, alpha=0.7, zorder=2
            )
            ax.vlines(positions, low, high, color=colour, lw=1.6, zorder=3)
            fills = [colour if panel_rows[i]["beyond_noise"] else "white" for i in order]
            ax.scatter(positions, middle, s=34, ec=colour, fc=fills, lw=1.3, zorder=4)
        words = [f"{spoken(name)} {_text(value)}" for name, value in zip(panels, part, strict=True)]
        ax.set_title(", ".join([*([titled(metric)] if len(metrics) > 1 else []), *words]))
        set_scales(ax, across)
        ax.axhline(0, color=MUTED_INK, lw=0.8, zorder=1)
        draw_horizontal_grid(ax)
        if len(metrics) > 1 or number % columns == 0:
            ax.set_ylabel(f"difference [{'%' if relative else numbers.unit or 1}]")
        ax.set_xlabel(across.label)
    for metric in metrics:  # the same scale for all of its panels
        alike = [
            ax
            for ax, (_, name) in zip(page.axes.ravel(), panel_cells, strict=False)
            if name == metric
        ]
        ends = [ax.get_ylim() for ax in alike]
        for ax in alike:
            ax.set_ylim(min(low for low, _ in ends), max(high for _, high in ends))
    handles = [
        _mark(SERIES[i % len(SERIES)], f"{spoken(series)} {_text(value)}")
        for i, value in enumerate(series_values)
        if series
    ]
    failed = sorted(
        ((row["failed_base"] + row["failed_other"], row) for row in rows), key=lambda pair: -pair[0]
    )
    best_texts = [
        f"{', '.join(_text(row[name]) for name in groups)} ({count})"
        for count, row in failed[:4]
        if count
    ]
    best_note = f", most at {'; '.join(best_texts)}" if best_texts else ""
    return page.finish(handles, f"{_MARKS}\n{profile}; {_runs(rows)}{best_note}")


def _mark(colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker="o", ms=5.5, lw=1.4, label=label)


def _runs(rows: Sequence[Row]) -> str:
    """How many runs went into it, and how many of them failed."""
    groups = {row["group"]: row for row in rows}.values()
    base, other_count = (
        sum(
            max(
                group_row["runs_" + side]
                for group_row in rows
                if group_row["group"] == row["group"]
            )
            for row in groups
        )
        for side in ("base", "other")
    )
    failed = [sum(row["failed_" + side] for row in groups) for side in ("base", "other")]
    fell = (
        f"; {failed[0]} of the base and {failed[1]} of the other fell or were lost"
        if any(failed)
        else "; none fell"
    )
    has_losses = any(
        row[f"lost_{side}"] and not row[f"failed_{side}"]
        for row in rows
        for side in ("base", "other")
    )
    return (
        f"{base:,} runs of the base, {other_count:,} of the other{fell}"
        + "; some have no number" * has_losses
    )


def _percent(share: float) -> str:
    """A share in percent with its sign."""
    percent = 100 * share
    text = (
        f"{percent:+,.0f}"
        if abs(percent) >= 100
        else f"{percent:+.3g}"
        if abs(percent) >= 10
        else f"{percent:+.1f}"
    )
    return ("0" if not round(percent, 1) else text).replace("-", "−")


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else spoken(str(value))


def _last(name: str) -> str:
    """The last part of a path."""
    return name.rstrip("/").rpartition("/")[2] or name
