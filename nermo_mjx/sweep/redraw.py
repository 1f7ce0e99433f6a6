"""The figures of a sweep's directory, from its table alone."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from matplotlib.figure import Figure

from nermo_mjx.plotting.files import Figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.sweep.chosen import check_column, chosen_figure
from nermo_mjx.sweep.plots import figures_of
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.summary import LEADING
from nermo_mjx.sweep.table import columns_of


def figures(
    out: Path,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Figures:
    """The figures of a sweep's directory, as far as it is finished.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `nermo_mjx.sweep.chosen.chosen_figure`; a metric as color alone gives
            the usual figures of that metric; without any of them, those of the speed are drawn.
        notify: called with a sentence where the table is not complete.

    Raises:
        ParameterError: there is no such column.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    files = sorted(path for path in out.glob("results/chunk-*.parquet") if re.fullmatch(r"chunk-\d+", path.stem))
    if not files:
        raise DirectoryError(
            f"{out} holds no results of its sweep yet: run nermo-mjx sweep {out / 'sweep.yaml'} --out {out}."
        )
    results, rows = Results.of_present(files), len(Sample(Sweep.from_file(out / "sweep.yaml")))
    remark = ""
    if results.rows < rows:
        remark = f"{results.rows:,} of {rows:,} runs so far; "
        if notify is not None:
            notify(f"{results.rows:,} of {rows:,} runs are in {out}; the figures show these.")
    else:
        results = Results.of_files(files, rows)
    if x is None and y is not None:
        raise ParameterError("y is given without x: name both, or x alone.")
    if x is None and color is not None and color not in columns_of(results, "metric"):
        check_column(results, color, "color")
        raise ParameterError(f"color is {color!r}, a parameter: name x and y, too.")
    if x is not None:
        return chosen_figure(results, x, y, color, remark)
    return _usual(out, results, color or LEADING, remark)


def _usual(out: Path, results: Results, metric: str, remark: str) -> Iterator[tuple[str, Figure]]:
    some = False
    for named in figures_of(results, (metric,), remark):
        some = True
        yield named
    if not some:
        why = "all its parameters have one value" if results.statuses()[0].any() else "no run went well"
        raise DirectoryError(f"there is nothing to draw of {out}: {why}.")
