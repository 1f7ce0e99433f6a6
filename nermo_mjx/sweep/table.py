"""The result table: one row per run, and in each column's metadata its unit, its meaning and its role.

Roles: `index` (row, variant, repeat, seed, body), `varied`, `randomized`, `metric`, `status`, `code`. A varied
structure is a column of texts whose `scale` is `structure`; a varied parameter is null where nothing reads it.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NotRequired

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv
from scipy import stats
from typing_extensions import TypedDict

from nermo_mjx.control.parameters import PUBLISHED_CLOCK_RATIO
from nermo_mjx.files import FileError, read_as
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.robot.parameters import GAIT_CODES
from nermo_mjx.robot.quantity import ParameterError, of_type
from nermo_mjx.rollout.metric_table import METRICS, RUN_COLUMNS, SIDES
from nermo_mjx.runs.code import session
from nermo_mjx.runs.directory import RunDirectory, Written, read_record
from nermo_mjx.runs.files import (
    DirectoryError,
    clear_errors,
    content_of,
    parquet_bytes,
    parquet_table,
    replace_file,
    to_json,
)
from nermo_mjx.runs.rows import Columns as Columns
from nermo_mjx.runs.rows import opened_part, part_files
from nermo_mjx.runs.status import Status, metadata_of, status_of
from nermo_mjx.sweep.counting import OF_ALL_RUNS, Tally, Variants, counts, losses
from nermo_mjx.sweep.spec import Rows, Sweep
from nermo_mjx.sweep.structures import about_structure
from nermo_mjx.trust import one_line


def chunk_table(
    sweep: Sweep,
    rows: Rows,
    index: np.ndarray,
    metrics: Mapping[str, np.ndarray],
    status: np.ndarray,
    code: str | np.ndarray,
    metadata: Mapping[str, Any],
) -> pa.Table:
    """The table of one chunk.

    Args:
        rows: the runs of the chunk, and `index` their positions in the sweep, (n,).
        metrics: name -> (n,) results; status: (n,) texts, "ok" where a run went well.
        code: short name of the code that made them, or (n,) names.
        metadata: what to note about the chunk in the schema's metadata (engine, steps, ...).
    """
    columns = Columns()
    parameters = sweep.parameters
    forms = {axis.name: axis.form for axis in sweep.axes} | {
        draw.name: draw.form for draw in sweep.draws
    }
    forms |= dict.fromkeys(sweep.body_parameters, "loguniform")  # the prior of the identification
    forms |= dict.fromkeys(sweep.varied if sweep.rows is not None else (), "values")
    numbers = (index, rows.variant, rows.repeat, rows.seed, rows.body)
    for (name, meaning), values in zip(RUN_COLUMNS.items(), numbers, strict=False):
        if values is not None:
            columns.add(name, values, "index", "1", meaning)
    for name in sweep.labelled:
        labels = np.array([walk.labels[name] for walk in sweep.structures], object)[rows.structure]
        columns.add(name, labels, "varied", "1", about_structure(name), scale="structure")
    means = {draw.name: repr(draw.mean()) for draw in sweep.draws}
    for name, values in rows.values.items():
        role = "varied" if name in sweep.varied else "randomized"
        scale = "log" if forms[name].startswith("log") else "linear"
        declaration = parameters[name]
        columns.add(
            *(name, values, role, declaration.unit, declaration.doc),
            nulls=True,
            scale=scale,
            mean=means.get(name),
        )
    for name, metric in sweep.metrics.items():
        if name in metrics:
            columns.add(
                name, metrics[name], "metric", metric.unit, metric.doc, better=metric.better
            )
    columns.add("status", np.asarray(status), "status", "1", RUN_COLUMNS["status"])
    codes = np.broadcast_to(np.asarray(code, object), len(index))
    columns.add("code", codes, "code", "1", RUN_COLUMNS["code"])
    sampler = "grid" if sweep.is_grid else sweep.sampler
    pairs = {"second_order": "true"} if sweep.second_order else {}
    profiles = dict.fromkeys(walk.setup.profile for walk in sweep.structures)
    return columns.table(
        {
            "sweep": sweep.digest(),
            "sampler": sampler,
            "profile": " ".join(profiles),
            **pairs,
            **metadata,
        }
    )


def joined(parts: Sequence[pa.Table], index: np.ndarray) -> pa.Table:
    """One table of several, its rows in the order of their numbers in `index`; what one does not know is null."""
    table = pa.concat_tables(parts, promote_options="default")
    order = np.argsort(index, kind="stable")
    positions = np.empty(len(index), int)
    positions[order] = np.argsort(table.column("row").to_numpy(), kind="stable")
    return table.take(positions)


def columns_of(table: Any, *roles: str) -> list[str]:
    """Names of the columns with one of the roles, in order; of whatever has a schema."""
    return [field.name for field in table.schema if meta(field).get("role") in roles]


def profiles_of(table: Any) -> list[str]:
    """The profiles of a table's walks, on which speeds and costs depend; none where an older table does not say it."""
    if "profile" in table.schema.names:  # they are varied
        return [
            name for name in dict.fromkeys(np.asarray(table.column("profile")).tolist()) if name
        ]
    return ((table.schema.metadata or {}).get(b"profile") or b"").decode().split()


def profile_text(profiles: Sequence[str]) -> str:
    """Profiles as headings and the notes of figures name them, and the clock of `as_published`.

    >>> profile_text(["exact"]), profile_text(["exact", "as_built"]), profile_text([])
    ('profile exact', 'profiles exact and as_built', 'profile not recorded')
    >>> profile_text(["as_published"])
    'profile as_published (as_published simulates 2.5 times the given frequency by default)'
    """
    named = f"profile{'s' * (len(profiles) > 1)} {' and '.join(profiles) or 'not recorded'}"
    clock = f" (as_published simulates {1 / PUBLISHED_CLOCK_RATIO:g} times the given frequency by default)"
    return named + clock * ("as_published" in profiles)


def labelled(table: Any) -> list[str]:
    """Names of the varied structures, whose columns are texts."""
    return [field.name for field in table.schema if meta(field).get("scale") == "structure"]


def meta(field: pa.Field) -> dict[str, str]:
    """A column's metadata as text: unit, description, role."""
    return {key.decode(): value.decode() for key, value in (field.metadata or {}).items()}


def better(field: pa.Field) -> str:
    """The better direction of a metric, one of `SIDES`; empty if there is none. Older tables contain few of them."""
    built_in = METRICS[field.name].better if field.name in METRICS else None
    return meta(field).get("better") or built_in or ""


def sides_in(schema: pa.Schema) -> dict[str, str]:
    """The metrics of a table that have a better direction, and its word, see `SIDES`."""
    return {field.name: SIDES[side] for field in schema if (side := better(field))}


# ---
# Reading the table: as a whole, or a few columns at a time if it would not fit into memory.


#: Schema metadata that differs between the parts of one table.
PART_KEYS = (b"chunk", b"series", b"steps", b"wall_seconds", b"engine", b"code")
#: Numbers held at once when several columns are wanted one after the other (each 8 bytes).
MAX_HELD_NUMBERS = 24_000_000
#: Files whose columns are joined at once: ten thousand small arrays would take more memory than their numbers.
_JOINED = 500


#: What a directory says of its sweep for those who only read it.
SWEEP_RECORD_FILE: Final = "sweep.json"
#: Its folder of the rows that are kept.
RECORDINGS: Final = "recordings"


_Asked = TypedDict(
    "_Asked", {"by": str, "base": NotRequired[str | float | None], "for": Sequence[str]}
)


@dataclasses.dataclass(frozen=True)
class SweepRecord:
    """A directory's sweep.json: what readers need of a sweep, so that none of them runs the code that it may name.

    Attributes:
        rows: of the whole sweep.
        fields: of the first structure's walk, as in a file; code by its digest.
        labelled: names of the varied structures.
        parameters: value of each parameter that is not varied, None where structures differ or do not read it.
        comparison: the section `compare`, if there is one.
        optimum: the section `optimum`, if there is one.
        variants, repeats: before further runs of some variants.
    """

    rows: int
    fields: Mapping[str, Any]
    labelled: Sequence[str]
    parameters: Mapping[str, float | None]
    comparison: _Asked | None
    optimum: Mapping[str, Any] | None = None
    variants: int = 0
    repeats: int = 0

    @classmethod
    def of_directory(cls, out: Path) -> SweepRecord | None:
        """What a directory has; None if it has none.

        Raises:
            DirectoryError: it is damaged.
        """
        if (content := content_of(out / SWEEP_RECORD_FILE)) is None:
            return None
        try:
            record: SweepRecord = read_as(content, cls, out / SWEEP_RECORD_FILE)
            if isinstance(record.fields.get("set"), dict):
                return record
        except FileError:
            pass
        raise DirectoryError(
            f"{out / SWEEP_RECORD_FILE} is damaged: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out} again."
        )


class Results:
    """A result table whose columns are read on demand, in the order of its rows.

    Attributes:
        schema: names, types and metadata of the columns, and of the table.
        rows: how many there are.
        well: which runs succeeded, (rows,) bool.
        statuses: how often each status occurs.
    """

    def __init__(self, source: pa.Table | Sequence[Path]) -> None:
        """
        Args:
            source: a table, or files of one; a column that other code did not know is null in its files.

        Raises:
            DirectoryError: a file cannot be read, now or when a column is asked for.
        """
        self._source, self._called = (
            source,
            "the table" if isinstance(source, pa.Table) else source[0],
        )
        self._names: dict[str, tuple[str, ...]] = {}
        if isinstance(source, pa.Table):
            schema = source.schema
        else:
            with opened_part(source[0]) as file:
                schema = file.schema_arrow
                schema = pa.schema(
                    [field for field in schema if field.name != "key"], schema.metadata
                )
        self.schema = schema.with_metadata(_common(schema))
        for name, is_kind in (("row", pa.types.is_integer), ("status", pa.types.is_string)):
            if name not in schema.names or not is_kind(schema.field(name).type):
                raise DirectoryError(
                    f"{self._called} has no column {name!r}, as results have: run the same command again."
                )
        table = self._read(["row", "status"])
        self._order = _order(table, once=not isinstance(source, pa.Table))
        self.rows, status = len(self._order), table.column("status").take(self._order)
        self.well = pc.equal(status, "ok").to_numpy()
        counts = {entry["values"]: entry["counts"] for entry in pc.value_counts(status).to_pylist()}
        self.statuses: dict[str, int] = dict(sorted(counts.items()))

    @property
    def is_grid(self) -> bool:
        """Whether the varied parameters are a grid's."""
        return (self.schema.metadata or {}).get(b"sampler") == b"grid"

    def names(self, column: str) -> tuple[str, ...]:
        """The different texts of a column, in the order in which they come."""
        if column not in self._names:
            self._names[column] = tuple(dict.fromkeys(self.column(column).tolist()))
        return self._names[column]

    def columns(self, names: Sequence[str]) -> Iterator[tuple[str, np.ndarray]]:
        """Columns one after the other, (rows,) each; the files are read as few times as memory allows."""
        at_once = max(1, MAX_HELD_NUMBERS // max(self.rows, 1))
        for start in range(0, len(names), at_once):
            table = self._read(names[start : start + at_once])
            for name in table.column_names:
                yield name, table.column(name).to_numpy()[self._order]
                table = table.drop([name])

    def column(self, name: str) -> np.ndarray:
        """One column, (rows,)."""
        return next(self.columns([name]))[1]

    def _read(self, names: Sequence[str]) -> pa.Table:
        """Some columns, in the order of the files."""
        if isinstance(self._source, pa.Table):
            return self._source.select(names)
        empty = pa.schema([self.schema.field(name) for name in names]).empty_table()
        tables = [empty]
        for start in range(0, len(self._source), _JOINED):
            batch = [empty]
            for path in self._source[start : start + _JOINED]:
                with opened_part(path) as file:
                    # With `row`, which each has: without any column it would have no rows.
                    part_table = file.read([*dict.fromkeys(["row", *names])], use_threads=False)
                    batch.append(part_table.replace_schema_metadata(None))
            tables.append(joined_tables(batch, path).select(names).combine_chunks())
        try:
            table = _with_gaits_named(pa.concat_tables(tables))
        except pa.ArrowInvalid:
            raise DirectoryError(
                f"{self._called} contains parts with different columns: run the same command again."
            ) from None
        for name, column in zip(table.column_names, table.columns, strict=True):
            # What the code of some rows did not know is null, but none of these.
            if column.null_count and (
                name in ("status", "code") or pa.types.is_integer(column.type)
            ):
                raise DirectoryError(
                    f"{self._called} has rows without {name!r}: run the same command again."
                )
        return table


def read_table(out: str | os.PathLike[str]) -> pa.Table:
    """The result table of a sweep's directory, or a search's, as far as it is complete, in the order of its rows.

    Each field's metadata has `unit`, `description` and `role` (index, varied, randomized, metric, status,
    code). Where several codes made the rows, what one of them did not know is null in its rows.

    Raises:
        DirectoryError: no readable part is there.
    """
    parts = []
    for path in part_files(
        Path(of_type("out", out, (str, os.PathLike), "the path of a directory"))
    ):
        with (
            contextlib.suppress(DirectoryError),
            opened_part(path) as file,
        ):  # a damaged one is left out
            parts.append(file.read([name for name in file.schema_arrow.names if name != "key"]))
    if not parts:
        raise DirectoryError(f"{out} holds no results of a sweep.")
    metadata = _common(parts[0].schema)
    table = _with_gaits_named(
        joined_tables([part.replace_schema_metadata(metadata) for part in parts], out)
    )
    del parts
    has_rows = "row" in table.column_names and not table.column("row").null_count
    if not has_rows or not pa.types.is_integer(table.schema.field("row").type):
        raise DirectoryError(
            f"{out} has results without their numbers, in the column 'row': run the same command again."
        )
    order = _order(table, once=True)
    if len(order) < table.num_rows:
        table, order = table.take(order), np.arange(len(order))
    for column_index, field in enumerate(
        table.schema
    ):  # column by column, so that none but one is there twice
        table = table.set_column(
            column_index, field, table.column(column_index).combine_chunks().take(order)
        )
    return table


def joined_tables(tables: Sequence[pa.Table], where: object) -> pa.Table:
    """Tables under one another; what one of them has not is null.

    Raises:
        DirectoryError: a column has different types in them.
    """
    try:
        return pa.concat_tables(tables, promote_options="default")
    except pa.ArrowException as error:
        reason = one_line(str(error).strip())
        raise DirectoryError(
            f"{where}: the files of its table differ ({reason}): run the same command again."
        ) from None


def _with_gaits_named(table: pa.Table) -> pa.Table:
    """The table with the names of gaits in the place of the author's codes, which former versions wrote."""
    for column_index, field in enumerate(table.schema):
        if field.name == "gait" and pa.types.is_string(field.type):
            codes = table.column(column_index).to_pylist()
            gait_names = pa.array([GAIT_CODES.get(gait, gait) for gait in codes], field.type)
            table = table.set_column(column_index, field, gait_names)
    return table


def _order(table: pa.Table, *, once: bool) -> np.ndarray:
    """Places of the rows in their order, (rows,); with `once` a row that two processes made counts once."""
    number = table.column("row").to_numpy()
    order = np.argsort(number, kind="stable")
    first = np.append(True, np.diff(number[order]) > 0)[: len(order)]
    return order[first] if once and not first.all() else order


def _common(schema: pa.Schema) -> dict[bytes, bytes]:
    """Metadata of the table, whatever its files have."""
    return {key: value for key, value in (schema.metadata or {}).items() if key not in PART_KEYS}


def sweep_status(out: Path) -> Status:
    """How many runs of its sweep a directory holds."""
    notes, rows, run_count, engines = list[str](), None, 0, list[str]()
    try:
        sweep = SweepRecord.of_directory(out)
        rows = None if sweep is None else sweep.rows
    except DirectoryError as error:
        notes.append(str(error))
    for path in part_files(out):
        if metadata := metadata_of(path, notes, "its runs will be made again."):
            run_count += metadata.num_rows
            engines.append((metadata.metadata or {}).get(b"engine", b"").decode())
    if recording_count := len(list((out / RECORDINGS).glob("row-*.npz"))):
        notes.append(
            f"{recording_count} of its runs {'are' if recording_count > 1 else 'is'} recorded in {RECORDINGS}/."
        )
    complete = rows is not None and run_count >= rows and (out / "summary.json").exists()
    # The figures need no simulation; the others are distinguished by the table's columns.
    engine = ", ".join(dict.fromkeys(filter(None, engines))) or None
    return status_of(
        "runs",
        out,
        run_count,
        rows,
        complete,
        command="sweep",
        spec="sweep.yaml",
        engine=engine,
        notes=notes,
    )


# ---
# summary.json: what a sweep's table says in numbers. SI units and radians, as in the table.


#: The metric whose dependence on each parameter is summed up.
LEADING = "speed"
#: Built-in metrics of which a summary names the best variants, and which figures show first.
MAIN_METRICS: Final = (
    *(LEADING, "cost_of_transport", "electrical_cost_of_transport", "servo_work", "slip"),
    *("roll_std", "pitch_std", "yaw_std", "lateral_drift"),
)


def summarize(table: pa.Table | Results) -> dict[str, Any]:
    """The summary of a complete table; few of its columns are in memory at once."""
    results = table if isinstance(table, Results) else Results(table)
    well = results.well
    varied, metrics = columns_of(results, "varied"), columns_of(results, "metric")
    labels = labelled(results)
    columns = results.columns(["variant", LEADING, *columns_of(results, "varied", "randomized")])
    variants = Variants.of(next(columns)[1])
    speed, correlations = next(columns)[1], {}
    for name, values in columns:
        if name not in labels:
            correlations[name] = rank_correlation(values[well], speed[well])
        if name in varied:
            variants.values[name] = values[variants.first]
    spreads, best, sides, leading = {}, {}, sides_in(results.schema), list[Any]()
    for name, values in results.columns([name for name in metrics if name not in OF_ALL_RUNS]):
        good = counts(name, values, well)
        words = ("mean", "std", "min", "max") if good.any() else ()
        spreads[name] = {word: float(getattr(values[good], word)()) for word in words}
        spreads[name]["lost"] = float(1 - good.mean())
        if name in sides and (name in MAIN_METRICS or name not in METRICS):
            best[name] = _best(results, variants, values, good, sides[name])
        if name == LEADING and labels:
            texts = list(zip(*(variants.values[label_text] for label_text in labels), strict=True))
            for label_text in dict.fromkeys(texts):
                is_of_text = np.array([text == label_text for text in texts])
                leading.append(_best(results, variants, values, good, sides[name], is_of_text))
    tally = variants.tally(speed, counts(LEADING, speed, well))
    marginal: dict[str, list[dict[str, Any]]] = {}  # over everything else
    for name in varied if results.is_grid else ():
        column, marginal[name] = variants.values[name], []
        for value in np.unique(column[column == column]).tolist():
            is_value = column == value
            if np.isfinite(tally.mean[is_value]).any():
                lost_share = float(1 - tally.count[is_value].sum() / tally.runs[is_value].sum())
                marginal[name].append(
                    {
                        "value": value,
                        LEADING: float(np.nanmean(tally.mean[is_value])),
                        "lost": lost_share,
                    }
                )
    return {
        "rows": results.rows,
        "variants": variants.all,
        "repeats": results.rows // variants.all,
        "profiles": profiles_of(results),
        "status": results.statuses,
        "metrics": spreads,
        "best": {name: best[name] for name in (*MAIN_METRICS, *best) if name in best},
        "best_of_each": list(filter(None, leading)),
        "marginal_means": marginal,
        "rank_correlations": correlations,
        "spine_gain": _spine_gain(variants.values, tally) if results.is_grid else [],
    }


def spine_ratio(results: Results) -> dict[str, np.ndarray]:
    """How fast each variant walks relative to the stiff spine.

    Returns:
        One entry per variant with a successful run: the varied parameters, `ratio` (speed over the mean speed at
        amplitude 0, all but the spine's phase equal; nan without such a run), and `base` (that mean speed).
    """
    columns = results.columns(["variant", LEADING, *columns_of(results, "varied")])
    variants = Variants.of(next(columns)[1])
    speed = next(columns)[1]
    mean = variants.tally(speed, counts(LEADING, speed, results.well)).mean
    is_finite = np.isfinite(mean)
    values = {name: column[variants.first][is_finite] for name, column in columns}
    ratio, base = _spine_ratio(values, mean[is_finite])
    return {**values, "ratio": ratio, "base": base}


def _best(
    results: Results,
    variants: Variants,
    values: np.ndarray,
    good: np.ndarray,
    side: str,
    candidates: np.ndarray | None = None,
) -> dict[str, Any] | None:
    """The variant with the best mean over its repeats of a metric (runs,) with a better direction, of those `among`
    (variants,); one with lost runs comes after all with fewer of them."""
    tally = variants.tally(values, good)
    ranked = tally.ranked(side)
    ranked = ranked if candidates is None else ranked[candidates[ranked]]
    if not len(ranked):
        return None
    best_index = int(ranked[0])
    best_rows = variants.place == best_index
    mean, is_single = (
        float(tally.mean[best_index]),
        tally.count[best_index] < 2,
    )  # whose spread is unknown
    return {
        "side": side,
        "variant": int(variants.number[best_index]),
        "mean": mean,
        "low": None if is_single else mean - float(tally.half[best_index]),
        "high": None if is_single else mean + float(tally.half[best_index]),
        "std": None if is_single else float(tally.std[best_index]),
        "runs": int(tally.count[best_index]),
        "lost": float(tally.lost[best_index]),
        "why": losses(results.column("status")[best_rows], good[best_rows])
        if tally.lost[best_index]
        else {},
        "parameters": _plain_number(variants.values, best_index),
    }


def _plain_number(values: Mapping[str, np.ndarray], index: int) -> dict[str, Any]:
    """The varied parameters and structures of a variant, as far as it has them."""
    parts = {name: column[index] for name, column in values.items()}
    return {
        name: column_values if isinstance(column_values, str) else float(column_values)
        for name, column_values in parts.items()
        if column_values == column_values
    }


def rank_correlation(parameter: np.ndarray, speed: np.ndarray) -> float:
    """Spearman's rank correlation of two columns (n,), where the first has a number; NaN if one of them is constant."""
    parameter, speed = parameter[~np.isnan(parameter)], speed[~np.isnan(parameter)]
    constant = len(speed) < 3 or np.ptp(parameter) == 0 or np.ptp(speed) == 0
    return math.nan if constant else float(stats.spearmanr(parameter, speed).statistic)


def _spine_ratio(
    values: Mapping[str, np.ndarray], speed: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Speed over speed at amplitude 0, all but the spine's phase equal, and that speed at amplitude 0."""
    group = np.zeros(len(speed), int)  # a number for each group of equal rows
    for name, column in values.items():
        if name not in ("spine", "spine.amplitude", "spine.phase"):
            distinct, distinct_index = np.unique(column, return_inverse=True)
            group = np.unique(group * len(distinct) + distinct_index, return_inverse=True)[1]
    still = ~(values["spine.amplitude"] > 0) & np.isfinite(
        speed
    )  # a structure without it has no number
    groups = int(group.max(initial=-1)) + 1
    runs = np.bincount(group[still], minlength=groups)
    total = np.bincount(group[still], speed[still], groups)
    base = np.where(runs > 0, total / np.maximum(runs, 1), math.nan)[group]
    return speed / np.where(base > 0, base, math.nan), base


def _spine_gain(values: Mapping[str, np.ndarray], tally: Tally) -> list[dict[str, Any]]:
    """Speed with the spine relative to the stiff spine; best and worst a frequency, of those with the fewest lost."""
    speed = tally.mean
    if "spine.amplitude" not in values:
        return []
    ratio, base = _spine_ratio(values, speed)
    ratio = np.where(values["spine.amplitude"] > 0, ratio, math.nan)
    lines = []
    for frequency in np.unique(values["frequency"]) if "frequency" in values else [None]:
        is_candidate = np.isfinite(ratio) & (
            True if frequency is None else values["frequency"] == frequency
        )
        line: dict[str, Any] = {} if frequency is None else {"frequency": float(frequency)}
        for word, pick in (("best", np.argmax), ("worst", np.argmin)):
            if is_candidate.any():
                is_candidate &= tally.lost == tally.lost[is_candidate].min()
                best_index = int(np.flatnonzero(is_candidate)[pick(ratio[is_candidate])])
                parameters = {
                    name: number
                    for name, number in _plain_number(values, best_index).items()
                    if name != "frequency"
                }
                line[word] = {
                    "ratio": float(ratio[best_index]),
                    "speed": float(speed[best_index]),
                    "speed_without": float(base[best_index]),
                    "lost": float(tally.lost[best_index]),
                    "parameters": parameters,
                }
        lines += [line] if is_candidate.any() else []
    return lines


# ---
# Stored reports on finished tables: a table in one file, or a directory of table, JSON and figures.


#: Endings of a table in one file.
TABLE_SUFFIXES: Final = (".parquet", ".csv")


def write_report(
    out: Path, kind: str, table: pa.Table, metadata: Mapping[str, Any], figures: Figures
) -> tuple[list[Path], str]:
    """Write a report, and return its files, and a message about files that were in the way, empty if there were none.

    Args:
        out: FILE.csv or FILE.parquet for the table alone, else a directory: KIND.parquet, KIND.json and plots/.
        kind: of the directory: "comparison" or "sensitivity".
        table: what was found.
        metadata: the same for JSON.
        figures: of it.

    Raises:
        ParameterError: the file has another ending.
        DirectoryError: it cannot be written, or holds something else.
    """
    if out.suffix in TABLE_SUFFIXES:
        with clear_errors(out.parent):
            out.parent.mkdir(parents=True, exist_ok=True)
            stream = io.BytesIO()
            csv.write_csv(table, stream)
            replace_file(
                out, parquet_bytes(table) if out.suffix == ".parquet" else stream.getvalue()
            )
        return [out], ""
    if out.is_file() or (out.suffix and not out.is_dir()):
        raise ParameterError(
            f"out is {str(out)!r}: allowed is a directory, FILE.parquet or FILE.csv."
        )
    with RunDirectory(out, kind) as directory, Written(directory) as written:
        paths = [directory.out / f"{kind}.parquet", directory.out / f"{kind}.json"]
        for path, content in zip(paths, (parquet_bytes(table), to_json(metadata)), strict=True):
            written.write(path, content)
        paths += write_figures(figures, directory.out / "plots", written.write)
        directory.note_session(session())
    return paths, written.sentence()


def report_table(out: Path, kind: str) -> pa.Table:
    """The table of a report's directory.

    Raises:
        DirectoryError: it is absent or damaged.
    """
    table = parquet_table(out / f"{kind}.parquet")
    if table is None:
        raise DirectoryError(
            f"{out / kind}.parquet is absent or damaged: run nermo-mjx {_REPORT_COMMANDS[kind]} again."
        )
    return table


def report_status(out: Path) -> Status:
    """The contents of a report's directory."""
    kind = str(read_record(out).get("kind"))
    table = parquet_table(out / f"{kind}.parquet")
    rows = 0 if table is None else table.num_rows
    return Status("lines", rows, rows, bool(rows), f"nermo-mjx plot {out}")


#: Which command makes a kind of report.
_REPORT_COMMANDS: Final = {"comparison": "compare", "sensitivity": "sensitivity"}
