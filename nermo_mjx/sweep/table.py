"""The result table: one row per run, and in each column's metadata its unit, its meaning and its role.

Roles: `index` (row, variant, repeat, seed, body), `varied`, `randomized`, `metric`, `status`, `code`. A varied
structure is a column of texts whose `scale` is `structure`; a varied parameter is null where nothing reads it.
"""

from __future__ import annotations

import dataclasses
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from pyarrow import csv
from scipy import stats

from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.columns import Columns as Columns
from nermo_mjx.runs.directory import RunDirectory, Written, read_record
from nermo_mjx.runs.files import DirectoryError, clear_errors, parquet_bytes, parquet_table, replace_file
from nermo_mjx.runs.provenance import session
from nermo_mjx.runs.status import Status
from nermo_mjx.runs.text import to_json
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sampling import Rows
from nermo_mjx.sweep.spec import Sweep, cost, sides_in
from nermo_mjx.sweep.structures import about_structure

_INDEX = {
    "row": "position of the run in the sweep",
    "variant": "index of the variant",
    "repeat": "index of the repeat within its variant",
    "seed": "seed of the row's random draws",
}


def chunk_table(
    sweep: Sweep,
    rows: Rows,
    index: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    status: np.ndarray,
    code: str | np.ndarray,
    about: Mapping[str, Any],
) -> pa.Table:
    """The table of one chunk.

    Args:
        rows: the runs of the chunk, and `index` their positions in the sweep, (n,).
        metrics: name -> (n,) results; status: (n,) texts, "ok" where a run went well.
        code: short name of the code that made them, or (n,) names.
        about: what to note about the chunk in the schema's metadata (engine, steps, ...).
    """
    columns = Columns()
    parameters = sweep.parameters
    forms = {axis.name: axis.form for axis in sweep.axes} | {draw.name: draw.form for draw in sweep.draws}
    forms |= dict.fromkeys(sweep.body_parameters, "loguniform")  # the prior of the identification
    forms |= dict.fromkeys(sweep.varied if sweep.rows is not None else (), "values")
    for name, values in zip(_INDEX, (index, rows.variant, rows.repeat, rows.seed), strict=True):
        columns.add(name, values, "index", "1", _INDEX[name])
    if rows.body is not None:
        columns.add("body", rows.body, "index", "1", "body of the identified ensemble; 0 is the default one")
    for name in sweep.labelled:
        labels = np.array([each.labels[name] for each in sweep.structures], object)[rows.structure]
        columns.add(name, labels, "varied", "1", about_structure(name), scale="structure")
    for name, values in rows.values.items():
        role = "varied" if name in sweep.varied else "randomized"
        scale = "log" if forms[name].startswith("log") else "linear"
        columns.add(name, values, role, parameters[name].unit, parameters[name].doc, nulls=True, scale=scale)
    for name, metric in sweep.metrics.items():
        if name in metrics:
            columns.add(name, metrics[name], "metric", metric.unit, metric.doc, better=metric.better)
    columns.add("status", np.asarray(status), "status", "1", "ok, or how the run ended")
    codes = np.broadcast_to(np.asarray(code, object), len(index))
    columns.add("code", codes, "code", "1", "which code made the row, as run.json names it")
    sampler = "grid" if sweep.is_grid else sweep.sampler
    pairs = {"second_order": "true"} if sweep.second_order else {}
    return columns.table({"sweep": sweep.digest(), "sampler": sampler, **pairs, **about})


def joined(parts: Sequence[pa.Table], index: np.ndarray) -> pa.Table:
    """One table of several, its rows in the order of their numbers in `index`; what one does not know is null."""
    table = pa.concat_tables(parts, promote_options="default")
    order = np.argsort(index, kind="stable")
    place = np.empty(len(index), int)
    place[order] = np.argsort(table.column("row").to_numpy(), kind="stable")
    return table.take(place)


def columns_of(table: Any, *roles: str) -> list[str]:
    """Names of the columns with one of the roles, in order; of whatever has a schema."""
    return [field.name for field in table.schema if meta(field)["role"] in roles]


def labelled(table: Any) -> list[str]:
    """Names of the varied structures, whose columns are texts."""
    return [field.name for field in table.schema if meta(field).get("scale") == "structure"]


def meta(field: pa.Field) -> dict[str, str]:
    """A column's metadata as text: unit, description, role."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


# ---
# summary.json: what a sweep's table says in numbers. SI units and radians, as in the table.


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
            correlations[name] = rank_correlation(values[well], speed)
        if name in varied:
            variants.values[name] = values[well][variants.first]
    spreads, best, sides = {}, {}, sides_in(results.schema)
    for name, values in results.columns([name for name in metrics if name not in ("fell", "diverged")]):
        good = values[well & np.isfinite(values)]
        words = ("mean", "std", "min", "max") if len(good) else ()
        spreads[name] = {word: float(getattr(good, word)()) for word in words}
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
        "parameters": _plain_number(variants.values, at),
    }


def _plain_number(values: Mapping[str, np.ndarray], at: int) -> dict[str, Any]:
    """The varied parameters and structures of a variant, as far as it has them."""
    parts = {name: column[at] for name, column in values.items()}
    return {name: each if isinstance(each, str) else float(each) for name, each in parts.items() if each == each}


def _marginal(parameter: np.ndarray, speed: np.ndarray) -> list[dict[str, Any]]:
    """Mean of the leading metric at each value of a parameter or structure, over everything else."""
    mean = ((value, float(np.nanmean(speed[parameter == value]))) for value in np.unique(parameter) if value == value)
    return [{"value": value if isinstance(value, str) else float(value), LEADING: each} for value, each in mean]


def rank_correlation(parameter: np.ndarray, speed: np.ndarray) -> float:
    """Spearman's rank correlation of two columns (n,), where the first has a number; NaN if one of them is constant."""
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
                parameters = {name: each for name, each in _plain_number(values, at).items() if name != "frequency"}
                line[word] = {
                    "ratio": float(ratio[at]),
                    "speed": float(speed[at]),
                    "speed_without": float(base[at]),
                    "parameters": parameters,
                }
        lines += [line] if here.any() else []
    return lines


# ---
# Stored reports on finished tables: a table in one file, or a directory of table, JSON and figures.


#: Endings of a table in one file.
TABLES: Final = (".parquet", ".csv")


def write_report(
    out: Path, kind: str, table: pa.Table, about: Mapping[str, Any], figures: Figures
) -> tuple[list[Path], str]:
    """Write a report, and return its files, and a message about files that were in the way, empty if there were none.

    Args:
        out: FILE.csv or FILE.parquet for the table alone, else a directory: KIND.parquet, KIND.json and plots/.
        kind: of the directory: "comparison" or "sensitivity".
        table: what was found.
        about: the same for JSON.
        figures: of it.

    Raises:
        ParameterError: the file has another ending.
        DirectoryError: it cannot be written, or holds something else.
    """
    if out.suffix in TABLES:
        with clear_errors(out.parent):
            out.parent.mkdir(parents=True, exist_ok=True)
            stream = io.BytesIO()
            csv.write_csv(table, stream)
            replace_file(out, parquet_bytes(table) if out.suffix == ".parquet" else stream.getvalue())
        return [out], ""
    if out.is_file() or (out.suffix and not out.is_dir()):
        raise ParameterError(f"out is {str(out)!r}: allowed is a directory, FILE.parquet or FILE.csv.")
    with RunDirectory(out, kind) as held, Written(held) as written:
        paths = [held.out / f"{kind}.parquet", held.out / f"{kind}.json"]
        for path, content in zip(paths, (parquet_bytes(table), to_json(about)), strict=True):
            written.write(path, content)
        paths += write_figures(figures, held.out / "plots", written.write)
        held.note_session(session())
    return paths, written.sentence()


def report_table(out: Path, kind: str) -> pa.Table:
    """The table of a report's directory.

    Raises:
        DirectoryError: it is absent or damaged.
    """
    table = parquet_table(out / f"{kind}.parquet")
    if table is None:
        raise DirectoryError(f"{out / kind}.parquet is absent or damaged: run nermo-mjx {_COMMANDS[kind]} again.")
    return table


def status(out: Path) -> Status:
    """The contents of a report's directory."""
    kind = str(read_record(out).get("kind"))
    table = parquet_table(out / f"{kind}.parquet")
    rows = 0 if table is None else table.num_rows
    return Status("lines", rows, rows, bool(rows), f"nermo-mjx plot {out}")


#: Which command makes a kind of report.
_COMMANDS: Final = {"comparison": "compare", "sensitivity": "sensitivity"}
