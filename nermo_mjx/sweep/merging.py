"""Merge directories of sweeps: the rows of all of them, each once, in a new directory."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from nermo_mjx.robot.quantity import of_type
from nermo_mjx.runs.files import (
    DirectoryError,
)
from nermo_mjx.runs.job import SILENT, Watch
from nermo_mjx.specs.reading import SpecError
from nermo_mjx.specs.walk import unread
from nermo_mjx.sweep.directory import fixed_differences, sweep_in
from nermo_mjx.sweep.run import SweepResult, run_sweep
from nermo_mjx.sweep.spec import Sample, Sweep
from nermo_mjx.trust import only_reading


def merge_sweeps(
    sources: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    accept_new_code: bool = False,
    watch: Watch = SILENT,
) -> SweepResult:
    """Merge directories of sweeps into a new one; nothing is simulated, and they stay as they are.

    >>> merge_sweeps(["runs/slow", "runs/slow"], "runs/slow")
    Traceback (most recent call last):
    nermo_mjx.specs.reading.SpecError: runs/slow is one of the directories that are merged: choose another one.

    Its sweep lists the variants of all of them as `rows`, with as many repeats as the one that has most. A row that is
    in several is taken from the first. Rows that none has are missing, and `sweep` runs them.

    No code of the directories is run: metrics are known by their names; sweeps of another controller are refused, and
    `run_sweep` takes their rows by `use`.

    Args:
        sources: the directories, two at least.
        out: where the result goes.
        accept_new_code: merge what different code made; the table's column `code` tells the rows apart.
        watch: is told if a part cannot be used.

    Raises:
        SpecError: there are less than two, or the result would go into one of them.
        DirectoryError: they differ in more than their rows, or cannot be read.
        OtherCode: different code made them.
    """
    expected = "a list of directories"
    listed = of_type("sources", sources, (list, tuple), expected)
    places = [Path(of_type("sources", source, (str, os.PathLike), expected)) for source in listed]
    if len(places) < 2:
        raise SpecError("merge takes two directories or more.")
    if Path(out).resolve() in [folder.resolve() for folder in places]:
        raise SpecError(f"{out} is one of the directories that are merged: choose another one.")
    with only_reading():
        return run_sweep(
            merged(places),
            out,
            use=places,
            simulate=False,
            accept_new_code=accept_new_code,
            watch=watch,
        )


def merged(places: Sequence[Path]) -> Sweep:
    """The sweep whose rows are those of all directories.

    Raises:
        DirectoryError: they differ in more than their rows, or have draws that do not go together.
    """
    sweeps = [sweep_in(folder) for folder in places]
    for folder, sweep in zip(places, sweeps, strict=True):
        if differences := fixed_differences(sweeps[0], sweep):
            raise DirectoryError(f"{places[0]} and {folder} cannot be merged: {differences}.")
        unshared = set(sweep.varied) ^ set(sweeps[0].varied)
        if unshared and any(source_sweep.draws or source_sweep.bodies for source_sweep in sweeps):
            raise DirectoryError(
                f"{places[0]} and {folder} cannot be merged: only one of them varies "
                f"{', '.join(sorted(unshared))}, on which the draws depend."
            )
    labelled = list(dict.fromkeys(name for sweep in sweeps for name in sweep.labelled))
    varied = list(dict.fromkeys(name for sweep in sweeps for name in sweep.varied))
    rows: dict[str, dict[str, Any]] = {}
    for folder, sweep in zip(places, sweeps, strict=True):
        for row in _rows(folder, sweep, labelled, varied):
            identical = {
                name: f"{value:.12g}" if isinstance(value, float) else value
                for name, value in row.items()
            }
            rows.setdefault(json.dumps(identical), row)
    repeats = max(sweep.repeats for sweep in sweeps)
    data = {
        name: value
        for name, value in sweeps[0].resolved().items()
        if name not in ("vary", "sample", "rows", "optimum", *labelled)
    }
    data["set"] = {name: value for name, value in data["set"].items() if name not in varied}
    if "physics" in labelled:
        data.pop("timestep", None)
    data["randomize"]["repeats"] = repeats
    data["plots"] = any(sweep.plots for sweep in sweeps)
    return Sweep.from_dict(data | {"rows": list(rows.values())})


def _rows(
    folder: Path, sweep: Sweep, labelled: Sequence[str], varied: Sequence[str]
) -> list[dict[str, Any]]:
    """The variants of a sweep as rows that name all structures and parameters that any of them varies."""
    variants = Sample(sweep).take(np.arange(sweep.variants) * sweep.repeats)
    fixed = []
    for structure in sweep.structures:
        labels: dict[str, Any] = {name: structure.written(name) for name in labelled}
        for name in varied:
            if name not in sweep.varied and unread(structure.setup, name) is None:
                if name not in structure.fixed:
                    raise DirectoryError(
                        f"{folder} cannot be merged: it neither varies nor sets {name}, which another one varies."
                    )
                labels[name] = structure.fixed[name]
        fixed.append(labels)
    variant_values = {name: variants.values[name].tolist() for name in sweep.varied}
    result = []
    for i, structure_index in enumerate(variants.structure.tolist()):
        values = {
            name: column[i] for name, column in variant_values.items() if column[i] == column[i]
        }
        values = {
            name: value
            for name, value in (fixed[structure_index] | values).items()
            if name in labelled or value == value
        }
        result.append({name: values[name] for name in (*labelled, *varied) if name in values})
    return result
