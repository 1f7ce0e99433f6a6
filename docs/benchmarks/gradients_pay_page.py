"""The page of searches by gradient and by CMA-ES: results in the same processor time, and missing searches."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure

from nermo_mjx.plotting.charts import horizontal_grid, page
from nermo_mjx.plotting.files import write_figures
from nermo_mjx.plotting.style import BEST, LINE, SERIES
from nermo_mjx.runs.files import table

PAGE: Final = "gradients_pay.md"
_COLOURS: Final = {"exact": LINE, "cma": BEST, "mixture": SERIES[2], "line_search": SERIES[3]}
_CALLED: Final = {"exact": "exact gradient", "mixture": "mixture", "line_search": "line search", "cma": "CMA-ES"}
_WAY: Final = ("parameters", "task", "gait", "cpu_s")
#: Share of a budget at which a curve is read, which excludes the last evaluation, since that exceeds the budget.
_GRID: Final = 200

#: Five seeds of four methods for five numbers of parameters, two tasks and three gaits.
PLANNED: Final = 600

Line = Mapping[str, Any]
Cell = tuple[Any, ...]


def figures(lines: Sequence[Line]) -> Iterator[tuple[str, Figure]]:
    """A figure for each cell that more than one method searched."""
    return ((_name(cell), _figure(cell, own)) for cell, own in _cells(lines).items() if _compares(own))


def text(lines: Sequence[Line]) -> str:
    """The page, in Markdown, from the finished searches."""
    cells = _cells(lines)
    headings = [
        "parameters",
        "task",
        "gait",
        "budget [CPU s]",
        "method",
        "seeds",
        "found",
        "range",
        "at equal simulated time",
        "to the first evaluation [CPU s]",
        "evaluations",
    ]
    parts = ["# Where gradients pay: the searches", "", *_INTRODUCTION, ""]
    parts += [table(headings, [row for cell, own in cells.items() for row in _rows(cell, own)]), ""]
    parts += [sentence for cell, own in cells.items() for sentence in _verdicts(cell, own)]
    parts += ["", f"{len(lines)} of the {PLANNED} planned searches were made.", ""]
    parts += [f"![{name}](plots/{name}.png)" for name in (_name(cell) for cell, own in cells.items() if _compares(own))]
    return "\n".join(parts).rstrip() + "\n"


def _cells(lines: Sequence[Line]) -> dict[Cell, list[Line]]:
    """The searches by what is searched, smallest number of parameters first."""
    cells: dict[Cell, list[Line]] = {}
    for line in sorted(lines, key=lambda line: line["parameters"]):
        cells.setdefault(tuple(line[name] for name in _WAY), []).append(line)
    return cells


def _compares(own: Sequence[Line]) -> bool:
    return len({line["method"] for line in own}) > 1


_INTRODUCTION: Final = (
    "Made by `gradients_pay_page.py` from `gradients_pay.jsonl`. Each search is a separate process that stops",
    "when it has used its processor time, which includes imports, the traced program and the compiled one from the",
    "cache, and all evaluations. *Found* is the median over the seeds of the best point's result on the engine `c`,",
    "the mean of eight walks from starts that no search has seen; speeds in mm/s, else the objective; lower is better.",
    "At equal simulated time a gradient in reverse mode counts as five runs; the curves are the searches' own values.",
    "*Line search*: the mean direction of gradients at four points; 16 points along it are walked on the engine `c`;",
    "its constants were chosen on seed 1 of the trot's speed with 32 parameters, so all other seeds are predictions.",
)


def _rows(cell: Cell, own: Sequence[Line]) -> list[list[str]]:
    """One row per method."""
    found = []
    equal = min(max(point[2] for point in line["curve"]) for line in own)
    for method in dict.fromkeys(line["method"] for line in own):
        mine = [line for line in own if line["method"] == method]
        ends, shared = [_end(line) for line in mine], [_shown(line, _at(line, 2, equal)) for line in mine]
        ready = np.median([line["ready_cpu_s"] for line in mine])
        count = np.median([line["evaluations"] for line in mine])
        found.append(
            [
                str(cell[0]),
                str(cell[1]),
                str(cell[2]),
                f"{cell[3]:g}",
                _CALLED[method],
                str(len(mine)),
                f"{np.median(ends):.1f}" if cell[1] == "speed" else f"{np.median(ends):.3f}",
                " to ".join(f"{each:.4g}" for each in (min(ends), max(ends))),
                f"{np.median(shared):.4g} after {equal:,.0f} s",
                f"{ready:.0f}",
                f"{count:,.0f}",
            ]
        )
    return found


def _verdicts(cell: Cell, own: Sequence[Line]) -> Iterator[str]:
    """Whether each method with gradients found a better gait than CMA-ES: medians over the seeds that both have."""
    for method in (name for name in _CALLED if name != "cma"):
        seeds = set.intersection(*({x["seed"] for x in own if x["method"] == name} for name in (method, "cma")))
        if not seeds:
            continue
        ends, rival = (
            np.median([_end(x) for x in own if x["method"] == name and x["seed"] in seeds]) for name in (method, "cma")
        )
        higher = cell[1] == "speed"
        wins, unit = (ends > rival) == higher, " mm/s" if higher else ""
        many = "1 seed" if len(seeds) == 1 else f"medians of {len(seeds)} seeds"
        yield (
            f"- {cell[0]} parameters, {cell[1]}, {cell[2]}: the {_CALLED[method]} "
            f"**{'wins' if wins else 'loses'}**, {ends:.4g}{unit} against {rival:.4g}{unit}, {many}."
        )


def _end(line: Line) -> float:
    """Result of the best point from unseen starts, in shown units; a gait that always fell counts as standing still."""
    found = line["found"]
    if found is None:
        return 0.0 if line["task"] == "speed" else float("inf")
    return 1e3 * float(found["metrics"]["speed"]) if line["task"] == "speed" else float(found["objective"])


def _shown(line: Line, objective: float) -> float:
    """A value of a curve in shown units: for the task `speed`, -1 is 100 mm/s."""
    return -100.0 * objective if line["task"] == "speed" else objective


def _at(line: Line, axis: int, until: float) -> float:
    """The best objective after an amount of an axis (1: processor time, 2: simulated time); NaN before the first."""
    known = [point[3] for point in line["curve"] if point[axis] <= until * (1 + 1e-9) and point[3] is not None]
    return min(known, default=float("nan"))


def _figure(cell: Cell, own: Sequence[Line]) -> Figure:
    """The best so far over processor time and over simulated time: median and range over the seeds."""
    title = f"{cell[0]} parameters, {cell[1]}, {cell[2]}"
    figure = page(title, 7.0, 3.2, "Median and range over the seeds; on the left from the start of the process.")
    for ax, axis, label in zip(figure.subplots(1, 2), (1, 2), ("processor time [s]", "simulated [s]"), strict=True):
        for method in dict.fromkeys(line["method"] for line in own):
            mine = [line for line in own if line["method"] == method]
            last = min(max(point[axis] for point in line["curve"]) for line in mine)
            until = np.linspace(0.0, last, _GRID)
            best = np.array([[_shown(line, _at(line, axis, each)) for each in until] for line in mine])
            known = np.isfinite(best).all(axis=0)
            until, best = until[known], best[:, known]
            ax.fill_between(until, best.min(axis=0), best.max(axis=0), color=_COLOURS[method], alpha=0.15, lw=0)
            ax.plot(until, np.median(best, axis=0), color=_COLOURS[method], label=_CALLED[method])
        ax.set(xlabel=label, ylabel="best speed [mm/s]" if cell[1] == "speed" else "best objective [1]")
        horizontal_grid(ax)
        if axis == 2:
            ax.legend()
    return figure


def _name(cell: Cell) -> str:
    return f"gradients_pay_{cell[0]}_{cell[1]}_{cell[2]}_{cell[3]:g}"


if __name__ == "__main__":
    folder = Path(__file__).parent
    runs = map(json.loads, (folder / "gradients_pay.jsonl").read_text().splitlines())
    lines = [line for run in runs for line in run["cases"] if "error" not in line]
    newest = {tuple(line[name] for name in (*_WAY, "method", "seed")): line for line in lines}
    newest = [newest[key] for key in sorted(newest)]
    write_figures(figures(newest), folder / "plots")
    (folder / PAGE).write_text(text(newest))
