"""Which figures a search gives: how it converged, its front or its atlas; and any columns of its table."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from matplotlib.figure import Figure

from nermo_mjx.plotting.files import Figures
from nermo_mjx.robot.quantity import ParameterError
from nermo_mjx.runs.files import DirectoryError
from nermo_mjx.search import figures as drawn
from nermo_mjx.search.batches import SEARCH, Evaluations
from nermo_mjx.search.spec import Search
from nermo_mjx.sweep.plots import chosen_figure, survey_figures
from nermo_mjx.sweep.results import Results, chunk_files


def figures_of(search: Search, results: Results) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a search's table; nothing where no point is allowed."""
    found = Evaluations.of(search, results)
    if found.best() is None:
        return
    if search.aim.measures:
        yield "atlas", drawn.atlas(found)
        yield "coverage", drawn.coverage(found)
    elif search.aim.pareto:
        yield "front", drawn.front(found)
        yield "hypervolume", drawn.hypervolume(found)
    else:
        yield "convergence", drawn.convergence(found)
    metric = search.aim.objective.terms[0].metric
    yield from ((name, figure) for name, figure in survey_figures(results, metric) if name.endswith("-parallel"))


def figures(
    out: Path,
    *,
    x: str | None = None,
    y: str | None = None,
    color: str | None = None,
    notify: Callable[[str], None] | None = None,
) -> Figures:
    """The figures of a search's directory, as far as it goes.

    Args:
        out: the directory.
        x, y, color: columns of one figure, see `nermo_mjx.sweep.plots.chosen_figure`.
        notify: not called: a search is drawn as far as it is.

    Raises:
        ParameterError: there is no such column.
        SpecError: its search.yaml cannot be read.
        DirectoryError: there is nothing to draw, or it cannot be read.
    """
    search, files = Search.from_file(out / SEARCH), list(chunk_files(out).values())
    if not files:
        command = f"nermo-mjx search {out / SEARCH} --out {out}"
        raise DirectoryError(f"{out} holds no results of its search yet: run {command}.")
    results = Results(files)
    if x is not None:
        return chosen_figure(results, x, y, color)
    if y is not None or color is not None:
        raise ParameterError("x is not given, beside y or color: name it, too.")
    if Evaluations.of(search, results).best() is None:
        raise DirectoryError(f"there is nothing to draw of {out}: no point is within the constraints.")
    return figures_of(search, results)
