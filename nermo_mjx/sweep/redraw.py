"""The figures of a sweep's directory once more, from its table alone."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from nermo_mjx.plotting.files import FORMATS
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import DirectoryError, clear_errors, make_writable, replace_file
from nermo_mjx.sweep.chosen import check_column, draw_chosen
from nermo_mjx.sweep.plots import draw_plots
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.sampling import Sample
from nermo_mjx.sweep.spec import Sweep
from nermo_mjx.sweep.summary import LEADING
from nermo_mjx.sweep.table import columns_of


def redraw(
    out: str | os.PathLike[str],
    folder: Path | None = None,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    formats: Sequence[str] = FORMATS,
    notify: Callable[[str], None] | None = None,
) -> list[Path]:
    """Draw the figures of a sweep's directory, as far as it is finished.

    Args:
        out: the directory.
        folder: where the files go; by default its `plots/`.
        x, y, color: columns of one figure, see `nermo_mjx.sweep.chosen.draw_chosen`; a metric as color alone gives the
            usual figures of that metric; without any of them, those of the speed are drawn.
        formats: of `png` and `svg`.
        notify: called with a sentence where the table is not complete.

    Returns:
        The files.

    Raises:
        ParameterError: there is no such column, or the folder cannot be written.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    out = Path(out)
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
    folder = out / "plots" if folder is None else folder
    make_writable(folder)
    with clear_errors(folder):
        if x is not None:
            return draw_chosen(results, folder, x, y, color, write=replace_file, formats=formats, remark=remark)
        drawn = draw_plots(
            results, folder, metrics=(color or LEADING,), write=replace_file, formats=formats, remark=remark
        )
    if not drawn:
        well = results.statuses()[0].any()
        why = "all its parameters have one value" if well else "no run went well"
        raise DirectoryError(f"there is nothing to draw of {out}: {why}.")
    return drawn
