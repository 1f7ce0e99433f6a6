"""The page of a directory: all runs of a sweep, a search or experiments, to filter, to brush and to play."""

from __future__ import annotations

import contextlib
import dataclasses
import os
import re
import shlex
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pydantic import BaseModel, Field

from nermo_mjx.files import json_of
from nermo_mjx.plotting import style
from nermo_mjx.plotting.charts import thin_out
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import ParameterError
from nermo_mjx.robot.parameters import PRESETS
from nermo_mjx.rollout import Setup
from nermo_mjx.rollout.metric_table import headed
from nermo_mjx.runs import DirectoryError, kind_of
from nermo_mjx.runs.directory import with_article
from nermo_mjx.runs.files import parquet_table
from nermo_mjx.specs.reading import SpecError, read_file
from nermo_mjx.sweep.counting import counts, same_values
from nermo_mjx.sweep.optimum import optimum_in
from nermo_mjx.sweep.optimum_tables import optimum_cells
from nermo_mjx.sweep.table import (
    LEADING,
    MAIN_METRICS,
    Results,
    SweepRecord,
    better,
    joined_tables,
    meta,
    read_table,
)
from nermo_mjx.view.clip import COMPACT_DETAIL, Models, clip_of
from nermo_mjx.view.page import Packer, Page, document, template

#: Roles of the columns that are shown, in this order; seeds and codes are not informative.
ROLES: Final = ("varied", "randomized", "metric", "status", "index")
#: Maximum number of rows in a page: 3 MB with 50 columns.
MAX_PAGE_ROWS: Final = 20_000
#: Number of best rows that are always kept.
_BEST_ROWS: Final = 500
#: Maximum number of values of a parameter that forms an axis of cells.
MAX_AXIS_CELLS: Final = 64


@dataclasses.dataclass(frozen=True)
class ExplorerColumn:
    """A column of the table.

    Attributes:
        name, unit, description, role: from its metadata, SI units.
        better: `high`, `low` or `zero`, the side that is better; empty if there is none.
        log: whether it was spread logarithmically.
        values: (n,) numbers, or texts.
    """

    name: str
    unit: str
    description: str
    role: str
    better: str
    log: bool
    values: np.ndarray

    @property
    def is_text(self) -> bool:
        """Whether it holds names, such as those of structures."""
        return self.values.dtype == object

    @property
    def distinct(self) -> np.ndarray:
        """Its distinct values, sorted, without NaN."""
        return np.unique(self.values if self.is_text else self.values[np.isfinite(self.values)])

    def cost(self) -> np.ndarray:
        """Its values, signed so that lower is better; without a better direction, higher values count as better."""
        signed = {"low": self.values, "zero": np.abs(self.values)}.get(self.better, -self.values)
        return np.where(np.isfinite(signed), signed, np.inf)


@dataclasses.dataclass(frozen=True)
class ExplorerRuns:
    """The runs of a directory.

    Attributes:
        kind: `atlas`, or that of the directory.
        columns: by name, in the order in which they are shown; of (n,) values each.
        rows: number of each run in its table, (n,).
        total: number of rows in the table.
        leading: the first requested metric.
        grid: whether the varied parameters form a grid.
        atlas: an atlas' objective and measures; None for other directories.
        gain_over: parameters over which a gain is shown first.
    """

    kind: str
    columns: Mapping[str, ExplorerColumn]
    rows: np.ndarray
    total: int
    leading: str
    grid: bool = False
    atlas: Mapping[str, Any] | None = None
    gain_over: tuple[str, ...] = ()

    @property
    def counts(self) -> np.ndarray:
        """Which runs count for the leading metric, (n,)."""
        values, status = self.columns[self.leading].values, self.columns.get("status")
        return counts(
            self.leading,
            values,
            np.full(len(values), True) if status is None else status.values == "ok",
        )

    def of(self, *roles: str) -> list[ExplorerColumn]:
        """Columns of these roles that differ between the runs."""
        return [
            column
            for column in self.columns.values()
            if column.role in roles and len(column.distinct) > 1
        ]


def runs_of(
    path: Path, required_rows: Collection[int] = (), limit: int = MAX_PAGE_ROWS
) -> ExplorerRuns:
    """The runs of a directory.

    Args:
        path: of a sweep, a search or experiments; if it has `atlas.parquet`, the cells are shown.
        required_rows: rows that are always included.
        limit: maximum number of rows; of more, the best and an even selection of the others.

    Raises:
        DirectoryError: it has no runs yet, or they cannot be read.
    """
    column: Callable[[str], np.ndarray]
    if (file := path / "atlas.parquet").exists():
        table = parquet_table(file)
        if table is None or not len(table):
            reason = (
                "cannot be read: run the same search again"
                if table is None
                else "has no filled cell yet"
            )
            raise DirectoryError(f"{file} {reason}.")
        schema, column = table.schema, lambda name: np.asarray(table.column(name).to_numpy())
    else:
        results = _results(path)
        schema, column = results.schema, results.column
    metadata = schema.metadata or {}
    fields = {field.name: meta(field) for field in schema}
    shown_fields = [
        name
        for role in ROLES
        for name, schema_field in fields.items()
        if schema_field.get("role") == role and name != "seed"
    ]
    metrics = [name for name in shown_fields if fields[name]["role"] == "metric"]
    atlas = (
        json_of(metadata[b"atlas"], _Atlas, path / "atlas.parquet")
        if b"atlas" in metadata
        else None
    )
    sides = {field.name: better(field) for field in schema}
    if atlas is None and not metrics:
        raise DirectoryError("The table has no metric: no column's role is 'metric'.")
    usual = (
        LEADING
        if LEADING in metrics
        else next(iter([*(name for name in metrics if sides[name]), *metrics]), "")
    )
    leading = usual if atlas is None else str(atlas["objective"]["metric"])
    number = column("row")
    price = _column(leading, fields[leading], sides[leading], column(leading)).cost()
    places = np.arange(len(number))
    if len(number) > limit:
        best = np.argsort(price, kind="stable")[: min(_BEST_ROWS, limit // 2)]
        places = np.union1d(thin_out(places, limit - len(best)), best)
        places = np.union1d(places, np.flatnonzero(np.isin(number, list(required_rows))))
    columns = {
        name: _column(name, fields[name], sides[name], column(name)[places])
        for name in shown_fields
        if name != "row"
    }
    if atlas is not None:
        side = "low" if atlas["objective"]["direction"] == "minimize" else "high"
        columns[leading] = dataclasses.replace(columns[leading], better=side)
    kind = "atlas" if atlas is not None else kind_of(path) or "sweep"
    grid = metadata.get(b"sampler") == b"grid"
    return ExplorerRuns(
        kind, columns, number[places].astype(np.int64), len(number), leading, grid, atlas
    )


def _results(path: Path) -> Results:
    """The table of a directory; of several experiments, their rows one after the other."""
    if files := sorted((path / "results").glob("*.parquet")):
        return Results(files)
    tables, experiments, first = [], _experiments(path), 0
    for folder in experiments:
        table = read_table(folder)
        name = pa.array([folder.name] * len(table))
        table = table.append_column(_EXPERIMENT, name) if len(experiments) > 1 else table
        for number in ("row", "variant"):
            place = table.schema.get_field_index(number)
            shifted = pc.add(table.column(place), first)
            table = table.set_column(place, table.schema.field(place), shifted)
        tables.append(table)
        first += len(table)
    if not tables:
        raise DirectoryError(
            f"{path} holds no results yet: nermo-mjx status {path} says how to resume."
        )
    return Results(joined_tables(tables, path))


_EXPERIMENT: Final = pa.field(
    "experiment",
    pa.string(),
    metadata={"unit": "1", "description": "its name", "role": "varied", "scale": "structure"},
)


def _experiments(path: Path) -> list[Path]:
    """The directories of rows of a directory of experiments, as far as they have some."""
    return sorted({part.parent.parent for part in path.glob("*/results/part-*.parquet")})


def recordings_in(path: Path) -> dict[int, Path]:
    """The recordings of a directory, by the numbers of their rows in `runs_of`."""
    first, found = 0, dict[int, Path]()
    for folder in [path] if (path / "results").is_dir() else _experiments(path):
        for file in sorted((folder / "recordings").glob("row-*.npz")):
            if number := re.fullmatch(r"row-(\d+)\.npz", file.name):
                found[first + int(number[1])] = file
        first += len(read_table(folder)) if folder != path else 0
    return found


class _Aim(BaseModel, extra="allow"):
    metric: str


class _Objective(_Aim):
    direction: Literal["minimize", "maximize"]


class _Atlas(BaseModel, extra="allow"):
    """What an atlas says of itself, as far as it is read."""

    objective: _Objective
    measures: Annotated[list[_Aim], Field(min_length=1, max_length=2)]


def _column(
    name: str, metadata: Mapping[str, str], side: str, values: np.ndarray
) -> ExplorerColumn:
    role = metadata["role"]
    if values.dtype.kind in "OUS" and any(isinstance(value, str) for value in values):
        values = np.array(["–" if value is None else str(value) for value in values], object)
    else:
        values = values.astype(float)  # None of a nullable column becomes NaN
    unit, log = metadata.get("unit", "1"), metadata.get("scale") == "log"
    return ExplorerColumn(name, unit, metadata.get("description", ""), role, side, log, values)


#: Choices that are options of `nermo-mjx walk`, with the values that it takes.
_WALK_OPTIONS: Final = (
    *("robot", "scene", "tail", "physics", "gait", "spine", "steering"),
    *("profile", "trajectory", "head", "tail_motion"),
)
#: Choices without an option: `walk` supports only their defaults.
_FIXED_CHOICES: Final = {"routing": Setup.routing, "cone": Setup.cone, "hinges": Setup.hinges}
#: Pilots that `walk` supports, and the parameters that their options set.
_PILOTS: Final = {"straight": (), "arc": ("radius", "direction"), "open_loop": ("turn_rate",)}
_TURNS: Final = {"left": 1.0, "right": -1.0}


def commands_of(path: Path, runs: ExplorerRuns) -> dict[str, Any]:
    """Commands of a directory's rows.

    Returns:
        `replay`: words to which the row's number is added, empty if rows cannot be replayed; `walk`: `words`,
        `options`, pairs of an option and the column of its value, and `set`, columns that `--set NAME=X` takes; None if
        `walk` cannot repeat the rows' runs. `profile`: of all rows; empty where it differs between them, or is not
        known.
    """
    spec = next(filter(Path.exists, (path / "sweep.yaml", path / "search.yaml")), None)
    walk, profile = None, ""
    with contextlib.suppress(SpecError):  # of another version; the readable part is shown
        if spec is not None:
            data = read_file(spec, runs.kind).data
            walk = _walk(data, runs)
            profile = "" if "profile" in runs.columns else str(data.get("profile", Setup.profile))
    return {
        "replay": f"nermo-mjx replay {shlex.quote(str(path))} --row" if spec else "",
        "walk": walk,
        "profile": profile,
    }


def _walk(spec: Mapping[str, Any], runs: ExplorerRuns) -> dict[str, Any] | None:
    """The `nermo-mjx walk` command for a row of a resolved file; None if it has no option for one of its choices."""
    varied = [column for column in runs.columns.values() if column.role in ("varied", "randomized")]
    names = {column.name: set(column.values) for column in varied if column.is_text}
    pilot_field = spec.get("pilot", Setup.pilot)
    pilot, options = (
        next(iter(pilot_field.items()))
        if isinstance(pilot_field, dict)
        else (str(pilot_field), None)
    )
    pilot_options: Mapping[str, Any] = options or {}
    step, preset = spec.get("timestep"), PRESETS.get(str(spec.get("physics", Setup.physics)))
    if (
        spec.get("controller") is not None
        or not set(names) <= {*_WALK_OPTIONS, "pilot"}
        or any(spec.get(name, default) != default for name, default in _FIXED_CHOICES.items())
        # A custom scene is stored as MJCF, which cannot be an option's value.
        or any("<" in scene for scene in names.get("scene", {str(spec.get("scene", Setup.scene))}))
        or (
            "physics" not in names
            and step is not None
            and (preset is None or float(step) != preset.timestep)
        )
        or not names.get("pilot", {pilot}) <= set(_PILOTS)
        or ("pilot" not in names and not set(pilot_options) <= set(_PILOTS[pilot]))
    ):
        return None
    fixed = dict(spec.get("set") or {})
    words = ["nermo-mjx", "walk"]
    for name in _WALK_OPTIONS:
        value = str(spec.get(name, getattr(Setup, name)))
        words += (
            [_option(name), value]
            if name not in names and value != str(getattr(Setup, name))
            else []
        )
    if "pilot" not in names:
        words += ["--pilot", pilot] if pilot != Setup.pilot else []
        fixed |= {f"pilot.{key}": _TURNS.get(value, value) for key, value in pilot_options.items()}
    run = spec.get("run") or {}
    length, warmup = ("duration", "warmup") if "duration" in run else ("cycles", "warmup_cycles")
    for option, name in ((f"--{length}", length), ("--warmup", warmup)):
        words += [option, f"{run[name]:.17g}"] if name in run else []
    for name, value in fixed.items():
        words += ["--set", f"{name}={value!r}"]
    return {
        "words": shlex.join(words),
        "options": [[_option(name), name] for name in (*_WALK_OPTIONS, "pilot") if name in names],
        "set": [column.name for column in varied if not column.is_text],
    }


def _option(name: str) -> str:
    return f"--{name.replace('_', '-')}"


#: Default maximum number of recordings in a page: 4 MB at ten seconds each.
MAX_RECORDINGS: Final = 50
#: Maximum number of distinct values of a column for which they are sent with all their digits.
_MAX_LISTED_VALUES: Final = 256
#: Maximum number of distinct values for which each is a step of an axis, even without a grid.
_MAX_AXIS_STEPS: Final = 12
_COLOUR_LEVELS: Final = 32


def explore(
    path: str | os.PathLike[str],
    *,
    recordings: int = MAX_RECORDINGS,
    height: int = 680,
    notify: Callable[[str], None] | None = None,
) -> Page:
    """The page of a directory of rows: every run as a point, or as a cell of an atlas or a grid.

    Columns can be selected for the axes and the colour, and brushed; clicking a run shows its numbers and the command
    that repeats it, and plays it in 3D if `recordings/` has it.

    Args:
        path: the directory of a sweep, a search or experiments; it is only read, and may be unfinished.
        recordings: maximum number in the page; of more, an even selection from the best to the worst.
        height: in a notebook [pixels].
        notify: called with a message about anything that is left out.

    Raises:
        DirectoryError: it is not such a directory, has no runs yet, or they cannot be read.
    """
    path = Path(path)
    recordings_by_row = recordings_in(path)
    runs = runs_of(path, recordings_by_row)
    notes = [f"{len(runs.rows):,} of {runs.total:,} runs: the best, and the others evenly."]
    notes = notes if len(runs.rows) < runs.total else []
    recorded_rows = np.flatnonzero(np.isin(runs.rows, list(recordings_by_row)))
    price = np.where(runs.counts, runs.columns[runs.leading].cost(), np.inf)
    ranked = runs.rows[recorded_rows[np.argsort(price[recorded_rows], kind="stable")]]
    chosen_rows = (
        ranked[thin_out(np.arange(len(ranked)), recordings)].tolist() if recordings > 0 else []
    )
    if len(chosen_rows) < len(recordings_by_row):
        notes.append(
            f"{len(chosen_rows)} of {len(recordings_by_row)} recordings, evenly from the best to the worst."
        )
    runs = with_gain(path, runs)
    table, shapes = Packer("table"), Packer("models")
    models = Models(shapes)
    clips, parts = _clips({row: recordings_by_row[row] for row in chosen_rows}, models, notes)
    if notify is not None:
        for note in notes:
            notify(note)
    name = path.resolve().name
    header = {
        "kind": runs.kind,
        "title": name,
        "directory": str(path),
        "notes": notes,
        "total": runs.total,
        "rows": table.plain(runs.rows, "uint32"),
        "fields": [_field(column, runs.grid, table) for column in runs.columns.values()],
        "start": start_of(runs),
        "atlas": runs.atlas,
        "optimum": _optimum(path),
        "palette": _palette(),
        "commands": commands_of(path, runs),
        "models": models.headers,
        "recordings": clips,
        "viewer": template("viewer") if clips else "",
    }
    title = f"Nermo: {name}, {with_article(runs.kind)}"
    html = document("explore", title, header, [table, shapes, *parts], ("", "explore"))
    return Page(html, height, rows=len(runs.rows), recordings=len(clips))


def _clips(
    files: Mapping[int, Path], models: Models, notes: list[str]
) -> tuple[dict[str, Any], list[Packer]]:
    """The clips of the page by row, and their packed parts.

    Args:
        files: Recordings by row.
        models: Models of the page.
        notes: Receives a sentence about each recording that is left out.
    """
    clips, parts = dict[str, Any](), list[Packer]()
    for row, path in files.items():
        packer = Packer(f"row-{row}")
        try:
            clip = clip_of(Recording.load(path), f"row {row}", models, packer, COMPACT_DETAIL)
        except (RecordingError, ParameterError) as error:
            notes.append(f"recordings/{path.name} is left out: {error}")
            continue
        model, clip["model"] = clip["model"], 0
        clips[str(row)] = {"part": packer.part, "model": model, "clip": packer.json(clip)}
        parts.append(packer)
    return clips, parts


def _optimum(path: Path) -> dict[str, Any] | None:
    """The answer of a sweep that seeks an optimum: its table, and of each line the group and the row to be shown."""
    optimum = optimum_in(path)
    if optimum is None:
        return None
    heads, cells = optimum_cells(optimum)
    lines = [
        # A gain stands below its mean, and a region's ranges below one another.
        {
            "cells": [
                re.sub(r" \((.*)\)$|(?<=[:,]) (?!.*\])", r"\n\1", cell) for cell in cell_names
            ],
            "group": answer.group,
        }
        | {"row": answer.rows[0] if answer.rows else None}
        for cell_names, answer in zip(cells, optimum.answers, strict=True)
    ]
    return {"title": optimum.title, "heads": heads, "lines": lines, "notes": optimum.how()}


def with_gain(path: Path, runs: ExplorerRuns) -> ExplorerRuns:
    """The runs with the gain that their file asks for, in the first metric; without one, as they are.

    It is over the base of the optimum or of the comparison, or over the stiff spine where a grid varies the amplitude
    of the spine from 0 and its phase: relative to the mean of those runs of the base that are like it but for what is
    compared. The runs of the base have none.
    """
    sweep = SweepRecord.of_directory(path)
    comparison: dict[str, Any] = dict(sweep.comparison or {}) if sweep is not None else {}
    names = {column.name for column in runs.of("varied")}
    if sweep is not None and sweep.optimum is not None:
        ((by, base),) = sweep.optimum["base"].items()
        comparison = {"by": by, "base": base, "for": sweep.optimum["over"]}
    elif not comparison and {"spine.amplitude", "spine.phase"} <= names and runs.grid:
        comparison = {
            "by": "spine.amplitude",
            "base": 0.0,
            "for": ["spine.amplitude", "spine.phase"],
        }
    if comparison.get("by") not in names:
        return runs
    by, leading, well = runs.columns[comparison["by"]], runs.columns[runs.leading], runs.counts
    if (base := comparison.get("base")) is None:
        base = "none" if by.is_text and "none" in by.distinct else by.values[0]
    of_base = (
        by.values == base
        if by.is_text
        else np.isclose(by.values, float(base), rtol=0.0, atol=1e-12)
    )
    if not (of_base & well).any() or (of_base | ~well).all():
        return runs
    # A stiff spine has no phase, whatever its column says.
    left_out = {by.name, "spine.phase"} if by.name == "spine.amplitude" else {by.name}
    keys = [runs.columns[name].values for name in sorted(names - left_out)]
    keys = [key if key.dtype == object else same_values(key) for key in keys]
    finite_keys = [key for key in keys if key.dtype == object or np.isfinite(key[of_base]).all()]
    texts = np.array(
        [np.zeros(len(of_base)).astype(str), *(key.astype(str) for key in finite_keys)]
    )
    alike = np.unique(texts, axis=1, return_inverse=True)[1]
    count = np.bincount(alike[of_base & well], minlength=alike.max() + 1)
    total = np.bincount(alike[of_base & well], leading.values[of_base & well], alike.max() + 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        gain = 100.0 * (leading.values / np.abs(total / count)[alike] - np.sign(total)[alike])
    values = np.where(well & ~of_base & np.isfinite(gain), gain, np.nan)
    text = by.values[of_base][0] if by.is_text else f"{by.name} {float(base):g}"
    description = f"{runs.leading.replace('_', ' ')} relative to the mean of {text}, all else equal"
    gain_column = ExplorerColumn(
        f"{runs.leading}_gain", "%", description, "metric", leading.better, False, values
    )
    return dataclasses.replace(
        runs,
        columns={gain_column.name: gain_column, **runs.columns},
        gain_over=tuple(comparison.get("for") or ()),
    )


def start_of(runs: ExplorerRuns) -> dict[str, Any]:
    """Initial view of the page: columns for both axes and the colour, cells or points, and which run a cell shows.

    A gain is the colour, over the parameters that it is compared for.
    """
    repeat = runs.columns.get("repeat")
    statistic = "mean" if repeat is not None and len(repeat.distinct) > 1 else "best"
    varied = runs.of("varied")
    metrics = runs.of("metric")
    gain = f"{runs.leading}_gain"
    colour = runs.leading
    gridded = [column for column in varied if runs.grid and len(column.distinct) <= MAX_AXIS_CELLS]
    cells = len(gridded) > 1
    if gain in runs.columns and cells:
        axes = sorted(gridded, key=lambda column: column.name not in runs.gain_over)[:2]
        x, y = (column.name for column in sorted(axes, key=lambda column: column.is_text))
        colour, statistic = gain, "mean"
    elif runs.atlas is not None:
        measures = [column["metric"] for column in runs.atlas["measures"]]
        x, y = [*measures, runs.leading][:2]
        cells = len(measures) > 1
    elif cells:
        # A number across, and structures above each other.
        steps, names = (
            [column.name for column in gridded if column.is_text == is_text]
            for is_text in (False, True)
        )
        x, y = (steps[:1] + names[:1] + steps[1:] + names[1:])[:2]
    else:
        directed = {
            column.name for column in metrics if column.better and column.name != runs.leading
        }
        colour = next(
            (name for name in (*MAIN_METRICS, *runs.columns) if name in directed), runs.leading
        )
        numbers = [column for column in [*varied, *runs.of("randomized")] if not column.is_text]
        others = [
            column.name for column in [*numbers, *varied, *metrics] if column.name != runs.leading
        ]
        x, y = [*others, runs.leading][0], runs.leading
    return {"x": x, "y": y, "colour": colour, "cells": cells, "of": statistic}


def _field(column: ExplorerColumn, grid: bool, packer: Packer) -> dict[str, Any]:
    """The header of a column, and its values packed."""
    unit = shown(column.name, column.unit, [1.0])
    gain = column.unit == "%" and column.name.endswith("_gain")
    cyclic = column.unit == "rad" and column.name.rpartition(".")[2] == "phase"
    field: dict[str, Any] = {
        "name": column.name,
        "role": column.role,
        "about": column.description,
        "unit": unit.unit,
        "factor": float(unit.values[0]),
        "better": column.better,
        "log": column.log,
        "group": headed().get(column.name),
        "colours": "gain" if gain else "cyclic" if cyclic else "",
    }
    values = column.distinct
    field["stepped"] = len(values) <= (
        MAX_AXIS_CELLS if column.is_text or (grid and column.role == "varied") else _MAX_AXIS_STEPS
    )
    if column.is_text:
        codes = np.searchsorted(values.astype(str), column.values.astype(str))
        return field | {"texts": values.tolist(), "values": packer.plain(codes, "uint16")}
    if len(values) <= _MAX_LISTED_VALUES:
        codes = np.where(
            np.isfinite(column.values), np.searchsorted(values, column.values), len(values)
        )
        return field | {"known": values.tolist(), "values": packer.plain(codes, "uint16")}
    return field | {"values": packer.floats(column.values, exact=column.role != "metric")}


def _palette() -> dict[str, Any]:
    """The common colours: of values from low to high, of categories, and of missing values."""
    from matplotlib import colormaps  # importing it takes a second
    from matplotlib.colors import to_hex

    names = {"scale": style.COLOUR_MAP, "gain": style.GAIN_COLOUR_MAP, "cyclic": "twilight"}
    scales = {
        key: [to_hex(c) for c in colormaps[name](np.linspace(0, 1, _COLOUR_LEVELS))]
        for key, name in names.items()
    }
    return {**scales, "series": list(style.SERIES), "missing": style.MISSING_COLOUR}
