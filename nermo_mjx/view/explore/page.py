"""The page of a directory: its runs as points or cells, packed, with its recordings."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any, Final

import numpy as np

from nermo_mjx.plotting import style
from nermo_mjx.plotting.shown import shown
from nermo_mjx.recording import Recording, RecordingError
from nermo_mjx.robot import ParameterError
from nermo_mjx.runs import DirectoryError, kind_of
from nermo_mjx.sweep.points import thinned
from nermo_mjx.sweep.sides import OBJECTIVES
from nermo_mjx.view.clip import COMPACT, Models, clip_of
from nermo_mjx.view.document import Page, document, text
from nermo_mjx.view.explore.commands import commands_of
from nermo_mjx.view.explore.runs import MOST_CELLS, Column, Runs, runs_of
from nermo_mjx.view.packing import Packer

#: Kinds of directories that have such a page.
KINDS: Final = ("sweep", "search")
#: Default maximum number of recordings in a page: 4 MB at ten seconds each.
MOST_RECORDINGS: Final = 50
#: Maximum number of distinct values of a column for which they are sent with all their digits.
_LISTED: Final = 256
#: Maximum number of distinct values for which each is a step of an axis, even without a grid.
_FEW: Final = 12
_LEVELS: Final = 32


def explore(
    path: str | os.PathLike[str],
    *,
    recordings: int = MOST_RECORDINGS,
    height: int = 680,
    notify: Callable[[str], None] | None = None,
) -> Page:
    """The page of a sweep's or a search's directory: every run as a point, or as a cell of an atlas or a grid.

    Columns can be selected for the axes and the colour, and brushed; clicking a run shows its numbers and the command
    that repeats it, and plays it in 3D if `recordings/` has it.

    Args:
        path: the directory; it is only read, and may be unfinished.
        recordings: maximum number in the page; of more, an even selection from the best to the worst.
        height: in a notebook [pixels].
        notify: called with a message about anything that is left out.

    Raises:
        DirectoryError: it is not such a directory, has no runs yet, or they cannot be read.
    """
    path = Path(path)
    if kind_of(path) not in KINDS:
        raise DirectoryError(f"{path} is neither the directory of a sweep nor that of a search: those have a page.")
    there = {
        int(found[1]): each
        for each in sorted((path / "recordings").glob("row-*.npz"))
        if (found := re.fullmatch(r"row-(\d+)\.npz", each.name))
    }
    runs = runs_of(path, there)
    notes = [f"{len(runs.rows):,} of {runs.total:,} runs: the best, and the others evenly."]
    notes = notes if len(runs.rows) < runs.total else []
    chosen = _chosen(runs, there, recordings)
    if len(chosen) < len(there):
        notes.append(f"{len(chosen)} of {len(there)} recordings, evenly from the best to the worst.")
    table, models = Packer("table"), Packer("models")
    clips, headers, parts = _clips({row: there[row] for row in chosen}, models, notes)
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
        "palette": _palette(),
        "commands": commands_of(path, runs),
        "models": headers,
        "recordings": clips,
        "viewer": text("page.html") if clips else "",
    }
    title = f"Nermo: {name}, {'an' if runs.kind == 'atlas' else 'a'} {runs.kind}"
    html = document("explore.html", title, header, [table, models, *parts], ("", "explore"))
    return Page(html, height, rows=len(runs.rows), recordings=len(clips))


def start_of(runs: Runs) -> dict[str, Any]:
    """Initial view of the page: columns for both axes and the colour, and cells or points."""
    varied, metrics = runs.of("varied"), runs.of("metric")
    numbers = [each for each in [*varied, *runs.of("randomized")] if not each.is_text]
    gridded = [each for each in varied if len(each.distinct) <= MOST_CELLS]
    if runs.atlas is not None:
        measures = [each["metric"] for each in runs.atlas["measures"]]
        x, y = [*measures, runs.leading][:2]
        return {"x": x, "y": y, "colour": runs.leading, "cells": len(measures) > 1}
    if runs.grid and len(gridded) > 1:
        # A number across, and structures above each other.
        steps, names = ([each.name for each in gridded if each.is_text == is_text] for is_text in (False, True))
        x, y = (steps[:1] + names[:1] + steps[1:] + names[1:])[:2]
        return {"x": x, "y": y, "colour": runs.leading, "cells": True}
    usual = [*OBJECTIVES]  # in the requested order
    directed = sorted(
        (each.name for each in metrics if each.better and each.name != runs.leading),
        key=lambda name: usual.index(name) if name in usual else len(usual),
    )
    others = [*[each.name for each in [*numbers, *varied]], *[each.name for each in metrics], runs.leading]
    across = next(name for name in others if name != runs.leading or name == others[-1])
    return {"x": across, "y": runs.leading, "colour": (directed or [runs.leading])[0], "cells": False}


def _chosen(runs: Runs, there: Collection[int], most: int) -> list[int]:
    """Rows whose recordings are included in the page, best first."""
    known = np.flatnonzero(np.isin(runs.rows, list(there)))
    ranked = known[np.argsort(runs.columns[runs.leading].cost()[known], kind="stable")]
    if most < 1:
        return []
    return [int(runs.rows[ranked[i]]) for i in thinned(np.arange(len(ranked)), most)]


def _clips(files: dict[int, Path], shapes: Packer, notes: list[str]) -> tuple[dict[str, Any], list[Any], list[Packer]]:
    """For each row its data part and the recording's header; the models' headers; the parts."""
    models = Models(shapes)
    clips, parts = {}, []
    for row, file in files.items():
        packer = Packer(f"row-{row}")
        try:
            clip = clip_of(Recording.load(file), f"row {row}", models, packer, COMPACT)
        except (RecordingError, ParameterError) as error:
            notes.append(f"recordings/{file.name} is left out: {error}")
            continue
        model, clip["model"] = clip["model"], 0
        clips[str(row)] = {"part": packer.part, "model": model, "clip": packer.json(clip)}
        parts.append(packer)
    return clips, models.headers, parts


def _field(column: Column, grid: bool, packer: Packer) -> dict[str, Any]:
    """The header of a column, and its values packed."""
    unit = shown(column.name, column.unit, [1.0])
    about: dict[str, Any] = {
        "name": column.name, "role": column.role, "about": column.description, "unit": unit.unit,
        "factor": float(unit.values[0]), "better": column.better, "log": column.log,
    }  # fmt: skip
    known = column.distinct
    about["stepped"] = len(known) <= (MOST_CELLS if column.is_text or (grid and column.role == "varied") else _FEW)
    if column.is_text:
        codes = np.searchsorted(known.astype(str), column.values.astype(str))
        return about | {"texts": known.tolist(), "values": packer.plain(codes, "uint16")}
    if len(known) <= _LISTED:
        codes = np.where(np.isfinite(column.values), np.searchsorted(known, column.values), len(known))
        return about | {"known": known.tolist(), "values": packer.plain(codes, "uint16")}
    return about | {"values": packer.floats(column.values, exact=column.role != "metric")}


def _palette() -> dict[str, Any]:
    """The common colours: of values from low to high, of categories, and of missing values."""
    from matplotlib import colormaps  # importing it takes a second
    from matplotlib.colors import to_hex

    scale = [to_hex(colour) for colour in colormaps[style.COLOURS](np.linspace(0, 1, _LEVELS))]
    return {"scale": scale, "series": list(style.SERIES), "missing": style.MISSING}
