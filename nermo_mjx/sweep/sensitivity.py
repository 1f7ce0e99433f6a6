"""Sensitivity of a metric: Sobol indices of a sweep's parameters with their intervals, by SALib."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from nermo_mjx.plotting.charts import FigurePage
from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.shown import spoken
from nermo_mjx.plotting.style import BAND_COLOUR, GRID, INK, LINE_COLOUR, MUTED_INK, OKABE_ITO
from nermo_mjx.robot.quantity import ParameterError, did_you_mean, require
from nermo_mjx.sweep.comparing import Source, opened_table
from nermo_mjx.sweep.counting import Variants, counts
from nermo_mjx.sweep.sampling import saltelli_size, unit_problem
from nermo_mjx.sweep.table import (
    LEADING,
    Columns,
    Results,
    columns_of,
    labelled,
    profile_text,
    profiles_of,
    report_table,
)

#: Resamples of SALib's bootstrap, the same ones in each call; SALib takes a seed of 0 for none.
_BOOTSTRAP: Final[dict[str, Any]] = {"num_resamples": 1000, "seed": 1}
#: Variants that the method for given data needs at least: it sorts them, and takes a spectrum.
_MIN_VARIANTS: Final = 65
_HARMONICS: Final = 10
_METHODS: Final = {
    "sobol": "first and total Sobol indices by Saltelli's design",
    "rbd_fast": "first Sobol indices from given data, by RBD-FAST: a sample of another design gives no interactions",
}


@dataclasses.dataclass(frozen=True)
class Sensitivity:
    """The result of `sensitivity`.

    Attributes:
        table: one row per index: the varied structures, if there are any; `parameter`, `second` (the other one of a
            pair, else empty), `order` ("first", "total" or "second"), `index`, `low`, `high` (its 95 % interval).
        metric: whose variance it is.
        method: "sobol", or "rbd_fast" where the sample is not of Saltelli's design.
        noise: Largest share of the variance that can be noise (of randomized parameters and starts), estimated from the
            spread of the repeats, whose mean has less because they are stratified; NaN with a single repeat.
        notes: omissions and caveats, in sentences.
    """

    table: pa.Table
    metric: str
    method: str
    noise: float
    notes: tuple[str, ...]

    def about(self) -> dict[str, Any]:
        """All of it for JSON: `indices` are the table's rows."""
        return {
            "metric": self.metric,
            "method": self.method,
            "about": _METHODS[self.method],
            "noise": self.noise,
            "indices": self.table.to_pylist(),
            "notes": list(self.notes),
        }


# Long because one analysis passes from the table to the report.
def sensitivity(source: Source, metric: str = LEADING) -> Sensitivity:
    """Each varied parameter's share of a metric's variance, alone (first) and including interactions (total).

    Indices are shares of the variance over the sample, with 95 % intervals of SALib's bootstrap. With `sample:
    {saltelli: N}` they are estimated as by Saltelli et al. (Comput. Phys. Commun. 181, 2010), first and total, with
    `second_order: true` of pairs, too. Any other random sample gives first indices, by RBD-FAST (Tarantola, Gatelli and
    Mara, 2006; Plischke, 2010). Each varied structure is analysed separately. What is randomized is noise: the first
    indices are shares of a variance that includes it, and each total index includes all of it. More repeats reduce it.

    >>> import tempfile
    >>> from nermo_mjx import run_sweep
    >>> spec = {"vary": {"frequency": {"uniform": [0.5, 0.9]}, "stride": {"uniform": [0.5, 0.9]}},
    ...         "sample": {"saltelli": 4}, "run": {"duration": 0.2}, "plots": False}
    >>> out = tempfile.mkdtemp()
    >>> _ = run_sweep(spec, out, engine="c")
    >>> sensitivity(out).table.column("order").to_pylist()
    ['first', 'total', 'first', 'total']

    Args:
        source: directory of a sweep, or its table.
        metric: a metric of the table.

    Raises:
        ParameterError: SALib is not installed, there is no such metric, or the table is of a grid, or too small.
        DirectoryError, SpecError: the directory holds no results, or cannot be read.
    """
    require("sensitivity", "SALib", "sensitivity")
    _, results, _, notes = opened_table(source)
    metrics = columns_of(results, "metric")
    if metric not in metrics:
        raise ParameterError(
            f"metric is {metric!r}: not one of the table{did_you_mean(metric, metrics)}"
        )
    metadata = results.schema.metadata or {}
    sampler, pairs = (
        metadata.get(b"sampler", b"").decode(),
        metadata.get(b"second_order") == b"true",
    )
    if sampler in ("grid", "rows") and columns_of(results, "varied"):
        raise ParameterError(
            f"sample is {sampler}, whose variants are not drawn at random: run a sweep with sample: {{saltelli: 256}}."
        )
    method, noises, lines = (
        "sobol" if sampler == "saltelli" else "rbd_fast",
        list[float](),
        list[dict[str, Any]](),
    )
    structures = {name: results.column(name) for name in labelled(results)}
    keys = list(zip(*structures.values(), strict=True)) if structures else [()] * results.rows
    for key in dict.fromkeys(keys):
        data = _data_of(
            results, metric, np.flatnonzero([group_key == key for group_key in keys]), notes
        )
        indices = _sobol(data, pairs, notes) if method == "sobol" else _given(data)
        lines += [dict(zip(structures, key, strict=True)) | line for line in indices]
        noises.append(data.noise)
    noise = float(np.mean(noises))
    if method == "rbd_fast":
        notes.append(
            "Interactions are not known from this sample: sample: {saltelli: N} gives total indices, too."
        )
    if any(line["index"] < 0 for line in lines):
        notes.append(
            "A share below 0 is the estimate's noise: it is not told apart from 0. More points tell it better."
        )
    if columns_of(results, "randomized") and columns_of(results, "varied"):
        about_noise = "; one repeat does not tell how much it is: give repeats"
        if math.isfinite(noise):
            bias_note = "a total index of a parameter without effect is about as large"
            bias_note = bias_note if method == "sobol" else "which no parameter explains"
            about_noise = f", at most {noise:.1%} of the variance: {bias_note}".replace("%", " %")
        notes.append(f"What is randomized counts as noise{about_noise}.")
    profile_note = profile_text(profiles_of(results))
    notes, columns = (
        [*dict.fromkeys(notes), f"{profile_note[:1].upper()}{profile_note[1:]}."],
        Columns(),
    )
    for name in structures:
        columns.add(
            name, np.array([line[name] for line in lines]), "varied", "1", name, scale="structure"
        )
    for name, role, text in (
        ("parameter", "index", "varied parameter"),
        ("second", "index", "the other parameter of a pair"),
        (
            "order",
            "index",
            "first: alone; second: of a pair, beyond each alone; total: with all others",
        ),
        ("index", "metric", "share of the metric's variance"),
        ("low", "metric", "lower end of its 95 % interval"),
        ("high", "metric", "upper end of it"),
    ):
        values = np.array([line[name] for line in lines], float if role == "metric" else None)
        columns.add(name, values, role, "1", text)
    table = columns.table(
        {"sensitivity": metric, "method": method, "noise": noise, "notes": "\n".join(notes)}
    )
    return Sensitivity(table, metric, method, noise, tuple(notes))


class _Data(NamedTuple):
    """A metric over the variants of one structure.

    Attributes:
        names: the parameters.
        inputs: their values, (variants, p).
        means: the metric's mean over the runs that count, (variants,); NaN where there is none.
        noise: share of the variance of the means that the repeats make.
    """

    names: list[str]
    inputs: np.ndarray
    means: np.ndarray
    noise: float


def _data_of(results: Results, metric: str, rows: np.ndarray, notes: list[str]) -> _Data:
    """The data of the structure of some rows (n,); notes about lost runs are added."""
    numbers = [name for name in columns_of(results, "varied") if name not in labelled(results)]
    names = numbers or columns_of(results, "randomized")
    variants = Variants.of(results.column("variant")[rows] if numbers else rows)
    values = results.column(metric)[rows]
    good = counts(metric, values, results.well[rows])
    tally = variants.tally(values, good)
    means, several, has_runs = tally.mean, tally.count > 1, tally.count > 0
    noise_variance = (
        np.mean(tally.std[several] ** 2 / tally.count[several]) if several.any() else math.nan
    )
    total_variance = np.nanvar(means) if has_runs.any() else math.nan
    inputs = np.column_stack([column[rows][variants.first] for _, column in results.columns(names)])
    is_read = ~np.isnan(inputs).all(axis=0)  # in this structure
    if not good.all():
        well = results.well[rows]
        words = (
            ("fell or were lost", int((~well).sum())),
            ("have no number", int((well & ~good).sum())),
        )
        why = " and ".join(
            f"{count:,} of {len(good):,} runs {reason}" for reason, count in words if count
        )
        notes.append(f"{why}, {int((~has_runs).sum()):,} variants with all of theirs.")
    if has_runs.any() and total_variance <= (1e-12 * np.nanmax(np.abs(means))) ** 2:
        raise ParameterError(
            f"metric is {metric!r}, which is the same in all variants: it depends on nothing."
        )
    noise = float(min(noise_variance / total_variance, 1.0)) if total_variance > 0 else math.nan
    return _Data(
        [name for name, is_there in zip(names, is_read, strict=True) if is_there],
        inputs[:, is_read],
        means,
        noise,
    )


def _sobol(data: _Data, pairs: bool, notes: list[str]) -> Iterator[dict[str, Any]]:
    from SALib.analyze import sobol

    names, block = data.names, saltelli_size(len(data.names), pairs)
    if len(data.means) % block:
        raise ParameterError(
            f"the table has {len(data.means):,} variants, not whole blocks of {block}: finish the sweep first."
        )
    blocks = data.means.reshape(-1, block)
    is_whole = np.isfinite(blocks).all(axis=1)
    if lost_count := int((~is_whole).sum()):
        notes.append(
            f"{lost_count:,} of {len(blocks):,} points are left out, of which a variant has no run that "
            "counts: the indices are of where the robot walks."
        )
    if is_whole.sum() < 4:
        raise ParameterError(
            f"only {int(is_whole.sum())} points have all of their variants: too few for indices."
        )
    analysis = sobol.analyze(
        unit_problem(len(names)), blocks[is_whole].ravel(), calc_second_order=pairs, **_BOOTSTRAP
    )
    for i, name in enumerate(names):
        yield _line(name, "first", analysis["S1"][i], analysis["S1_conf"][i])
        yield _line(name, "total", analysis["ST"][i], analysis["ST_conf"][i])
    for i, j in itertools.combinations(range(len(names)), 2) if pairs else ():
        yield _line(names[i], "second", analysis["S2"][i, j], analysis["S2_conf"][i, j], names[j])


def _given(data: _Data) -> Iterator[dict[str, Any]]:
    from SALib.analyze import rbd_fast

    good = np.isfinite(data.means)
    if good.sum() < _MIN_VARIANTS:
        raise ParameterError(
            f"{int(good.sum())} variants went well: RBD-FAST needs {_MIN_VARIANTS} or more."
        )
    problem = unit_problem(len(data.names))
    analysis = rbd_fast.analyze(
        problem, data.inputs[good], data.means[good], M=_HARMONICS, **_BOOTSTRAP
    )
    for i, name in enumerate(data.names):
        yield _line(name, "first", analysis["S1"][i], analysis["S1_conf"][i])


def _line(
    parameter: str, order: str, index: float, half: float, second: str = ""
) -> dict[str, Any]:
    ends = {"index": float(index), "low": float(index - half), "high": float(index + half)}
    return {"parameter": parameter, "second": second, "order": order, **ends}


def strongest(table: pa.Table) -> list[str]:
    """The parameters of a table of indices, that with the largest index first, by their totals if these are known."""
    lines: Sequence[Mapping[str, Any]] = table.to_pylist()
    order = "total" if any(line["order"] == "total" for line in lines) else "first"
    largest_by_name: dict[str, float] = {}
    for line in lines:
        if line["order"] == order:
            largest_by_name[line["parameter"]] = max(
                largest_by_name.get(line["parameter"], -math.inf), line["index"]
            )
    return sorted(largest_by_name, key=lambda name: -largest_by_name[name])


# ---
# Figures of Sobol indices, from their table alone: a bar for each parameter alone and with interactions.


Line = Mapping[str, Any]
#: Bars, and panels, of one figure.
_MOST_PARAMETERS: Final = 16
_MAX_SHOWN_PAIRS: Final = 10
_MAX_INDEX_PANELS: Final = 6
_ORDER_COLOURS: Final = {"first": LINE_COLOUR, "total": BAND_COLOUR, "second": OKABE_ITO["purple"]}
_WORDS: Final = {
    "first": "alone (first)",
    "total": "with all others (total)",
    "second": "of a pair (second)",
}


def sensitivity_figures(out: Path) -> Figures:
    """The figures of a sensitivity's directory.

    Raises:
        DirectoryError: its table is absent or damaged.
    """
    return figures_of_indices(report_table(out, "sensitivity"))


def figures_of_indices(table: pa.Table) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a table of indices; a panel for each structure, and one for its pairs."""
    metadata = {
        key.decode(): value.decode() for key, value in (table.schema.metadata or {}).items()
    }
    lines, metric, structures = table.to_pylist(), metadata["sensitivity"], labelled(table)
    parts = list(dict.fromkeys(tuple(line[name] for name in structures) for line in lines))[
        :_MAX_INDEX_PANELS
    ]
    names = strongest(table)[:_MOST_PARAMETERS]
    orders = list(dict.fromkeys(line["order"] for line in lines))
    pairs, single = "second" in orders, "total" not in orders
    columns = 2 if pairs else min(len(parts), 2)
    rows = len(parts) if pairs else -(-len(parts) // columns)
    size = (5.6 if columns == 1 else 9.6, rows * (0.34 * len(names) + 0.9) + 1.2)
    page = FigurePage(f"What {spoken(metric)} depends on", size, rows, columns)
    places = iter(page.axes.ravel())
    for part in parts:
        structure_lines = [
            line for line in lines if tuple(line[name] for name in structures) == part
        ]
        title = ", ".join(f"{name} {value}" for name, value in zip(structures, part, strict=True))
        ax = next(places)
        for order, shift in (("total", 0.19), ("first", 0.0 if single else -0.19)):
            of_order = {
                line["parameter"]: line for line in structure_lines if line["order"] == order
            }
            shown_places = [position for position, name in enumerate(names) if name in of_order]
            _bars(
                ax,
                np.array(shown_places) + shift,
                [of_order[names[position]] for position in shown_places],
                0.38 if shift else 0.6,
            )
        _finish(ax, names, title)
        if pairs:
            ax, second_order = (
                next(places),
                [line for line in structure_lines if line["order"] == "second"],
            )
            second_order = sorted(second_order, key=lambda line: -line["index"])[:_MAX_SHOWN_PAIRS]
            _bars(ax, np.arange(len(second_order), dtype=float), second_order, 0.6)
            _finish(ax, [f"{line['parameter']}\n{line['second']}" for line in second_order], title)
    for ax in places:
        ax.remove()
    handles = [Patch(fc=_ORDER_COLOURS[order], label=_WORDS[order]) for order in orders]
    hidden_count = len(strongest(table)) - len(names)
    note = (
        "share of the variance; lines: 95 % intervals"
        + f"; {hidden_count} weaker ones are in the table" * (hidden_count > 0)
    )
    yield f"{metric}-sensitivity", page.finish(handles, f"{note}\n{metadata['notes']}".strip())


def _bars(ax: Axes, places: np.ndarray, lines: Sequence[Line], height: float) -> None:
    if lines:
        values = np.array([[line["index"], line["low"], line["high"]] for line in lines])
        ax.barh(places, values[:, 0], height, color=_ORDER_COLOURS[lines[0]["order"]])
        ax.hlines(places, values[:, 1], values[:, 2], color=INK, lw=1.0)


def _finish(ax: Axes, names: Sequence[str], title: str) -> None:
    ax.axvline(0, color=MUTED_INK, lw=0.8)
    ax.set_yticks(range(len(names)), names)
    ax.set(ylim=(max(len(names), 1) - 0.4, -0.6), title=title, xlabel="Sobol index [1]")
    low, high = ax.get_xlim()
    ax.set_xlim(max(low, -0.5), min(max(high, 0.1), 1.5))
    ax.grid(axis="x", color=GRID, lw=0.8)
