"""The optimum of a sweep as a table: of a terminal, as CSV, as LaTeX, and as Parquet."""

from __future__ import annotations

import io
import itertools
import math
from typing import Final

import numpy as np
import pyarrow as pa
from pyarrow import csv

from nermo_mjx.plotting.shown import titled
from nermo_mjx.sweep.optimum import FoundOptimum
from nermo_mjx.sweep.table import (
    Columns,
    meta,
    profile_text,
    profiles_of,
)


def optimum_cells(optimum: FoundOptimum) -> tuple[list[str], list[list[str]]]:
    """Headings and cells of the short table for people, a line for each group: means ± half an interval, and gains."""
    heads = [*map(titled, optimum.answers[0].group), *map(titled, optimum.answers[0].points)]
    heads += [*map(titled, optimum.metrics), "Not told from it"]
    lines = []
    for answer in optimum.answers:
        line = [titled(optimum.text(name, value)) for name, value in answer.group.items()]
        if answer.at:
            line += [optimum.text(name, value) for name, value in answer.at.items()]
            for name in optimum.metrics:
                mean, *gain = optimum.numbers(answer, name)
                line.append(f"{mean} ({' '.join(gain)})")
            line.append(optimum.region(answer))
        lines.append([*line, *["–"] * (len(heads) - len(line))])
    return heads, lines


def optimum_latex(optimum: FoundOptimum) -> str:
    """The short table as a LaTeX tabular, without packages."""
    heads, lines = optimum_cells(optimum)
    marks = {"%": r"\%", "±": r"$\pm$", "−": "$-$", "–": "--", "_": r"\_", "&": r"\&"}
    rows = [
        " & ".join("".join(marks.get(sign, sign) for sign in cell) for cell in line)
        for line in (heads, *lines)
    ]
    body = [f"{rows[0]} \\\\ \\hline", *(f"{row} \\\\" for row in rows[1:])]
    notes = [
        f"% {line_text}"
        for line_text in (
            f"{profile_text(profiles_of(optimum.results))}; base: {optimum.base}",
            *optimum.how(),
        )
    ]
    return "\n".join(
        [*notes, f"\\begin{{tabular}}{{{'l' * len(heads)}}}", *body, "\\end{tabular}", ""]
    )


def optimum_table(optimum: FoundOptimum) -> pa.Table:
    """A row for each group and metric, SI units: the best point, and what fresh runs say of it."""
    lines = [
        {**answer.group, **answer.at, "metric": name, "region": int(answer.judged.region.sum())}
        | dict(line)
        for answer in optimum.answers
        for name, line in answer.lines.items()
    ]
    columns, schema = Columns(), optimum.results.schema
    for name in dict.fromkeys(itertools.chain(*lines)):
        metadata = meta(schema.field(name)) if name in schema.names else {}
        role = "varied" if metadata else "index" if name in ("metric", "region") else "metric"
        doc = metadata.get("description", _ANSWER_FIELDS.get(name, name))
        unit = metadata.get(
            "unit",
            "that of the metric" if name in _OF_THE_METRIC else "1",
        )
        values = np.array([line.get(name, math.nan) for line in lines])
        columns.add(name, values, role, unit, doc, nulls=True)
    return columns.table({"optimum": optimum.asked.metric, "base": optimum.base})


_OF_THE_METRIC: Final = frozenset(
    [f"{side}{end}" for side in ("mean", "base") for end in ("", "_low", "_high")]
    + ["difference", "low", "high"]
)
_ANSWER_FIELDS: Final = {
    "metric": "what it is about",
    "region": "number of points that cannot be told from the best one",
    "mean": "mean of the best point's fresh runs; _low and _high: its 95 % interval",
    "base": "mean of the base's fresh runs; _low and _high: its 95 % interval",
    "difference": "best point minus base, in fresh runs; low and high: its 95 % interval",
    "relative": "of pairs, the geometric mean of their ratios, minus 1; otherwise the difference over the magnitude of "
    "the base's mean; _low and _high: its 95 % interval",
    "pairs": "number of pairs of fresh runs with the same samples",
    "outliers": "number of pairs whose difference lies more than five standard deviations from the median",
    "slope": "change of the relative difference for 1 unit of the parameter of `explain`",
    "r2": "share of the variance of the differences that this parameter explains",
    "p": "probability of so large a difference by chance, two-sided",
}


def optimum_files(optimum: FoundOptimum) -> dict[str, bytes]:
    """The tables as files of a directory, by name, beside the Parquet file."""
    stream = io.BytesIO()
    csv.write_csv(optimum_table(optimum), stream)
    return {"optimum.csv": stream.getvalue(), "optimum.tex": optimum_latex(optimum).encode()}
