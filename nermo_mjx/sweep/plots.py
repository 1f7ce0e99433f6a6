"""Which figures a sweep's table gives.

Heat maps over pairs of a grid, a line for one parameter, scatters of a sample; and, where two parameters or more tell
the variants apart, parallel coordinates and the Pareto front of speed against roll.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib.figure import Figure
from scipy import stats

from nermo_mjx.plotting.files import FORMATS, write_figures
from nermo_mjx.plotting.quantity import Quantity
from nermo_mjx.runs.files import replace_file
from nermo_mjx.sweep.figures import heat_maps, line, pair_scatters, scatters
from nermo_mjx.sweep.points import quantity
from nermo_mjx.sweep.results import Results
from nermo_mjx.sweep.summary import LEADING, cost, spine_ratio
from nermo_mjx.sweep.survey import survey_figures
from nermo_mjx.sweep.table import columns_of

#: A figure has no more panels than this; more values are thinned evenly.
MOST_PANELS = 12
#: A scatter has no more points than this; more are thinned evenly.
MOST_POINTS = 50_000
#: Pairs are drawn among this many parameters: the first of a grid, the most influential of a sample.
MOST_PAIRED = 4


def draw_plots(
    table: pa.Table | Results,
    folder: Path,
    *,
    metrics: Sequence[str] = ("speed",),
    write: Callable[[Path, bytes], None] = replace_file,
    formats: Sequence[str] = FORMATS,
    remark: str = "",
) -> list[Path]:
    """Draw the figures of a result table as PNG and SVG.

    Args:
        table: as `read_table` returns it, or `Results`, of which only the columns drawn are read.
        folder: where the files go.
        metrics: the metrics to draw; one that the table lacks is left out.
        write: how a file is written; by default whole or not at all.
        formats: of `png` and `svg`.
        remark: what the note of each figure begins with.

    Returns:
        The files, in the order drawn.
    """
    results = table if isinstance(table, Results) else Results.of_table(table)
    return write_figures(figures_of(results, metrics, remark), folder, write, formats)


def figures_of(results: Results, metrics: Sequence[str], remark: str = "") -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of each metric that the table has."""
    for metric in metrics:
        yield from _figures(results, metric, remark) if metric in results.schema.names else []


def _figures(results: Results, metric: str, remark: str = "") -> list[tuple[str, Figure]]:
    """(file name, figure) of one metric; only runs that went well count."""
    well, _ = results.statuses()
    if not well.any():
        return []
    return [*_over_parameters(results, metric, well, remark), *survey_figures(results, metric, remark)]


def _over_parameters(results: Results, metric: str, well: np.ndarray, remark: str) -> list[tuple[str, Figure]]:
    """Maps, lines or scatters of a metric over the parameters."""
    z = quantity(results, metric, np.where(well, results.column(metric), np.nan))
    varied = [x for x in _quantities(results, columns_of(results, "varied")) if np.ptp(x.values) > 0]
    if (results.schema.metadata or {}).get(b"sampler") == b"grid" and varied:
        repeats = int(np.max(results.column("repeat"))) + 1
        note = remark + (f"mean of {repeats} repeats; " if repeats > 1 else "")
        if len(varied) == 1:
            x = varied[0]
            return [(f"{metric}-over-{x.name}", line(x, z, f"{_title(metric)} over {x.name}", note))]
        return _heat_map_figures(varied, z, note) + _gain_figures(results, metric, remark)
    drawn = varied or _quantities(results, columns_of(results, "randomized"))
    return _scatter_figures(drawn, z, metric, remark)


def _heat_map_figures(varied: list[Quantity], z: Quantity, note: str) -> list[tuple[str, Figure]]:
    """A heat map a pair."""
    pairs = itertools.combinations(varied[:MOST_PAIRED], 2)
    return [(f"{z.name}-over-{x.name}-and-{y.name}", heat_map(x, y, varied, z, note)) for x, y in pairs]


def heat_map(x: Quantity, y: Quantity, varied: Sequence[Quantity], z: Quantity, note: str) -> Figure:
    """A heat map of z over two parameters; with a third one that varies, one panel for each of its values."""
    panels, remark = _panels([other for other in varied if other.name not in (x.name, y.name)], len(z.values))
    return heat_maps(x, y, z, panels, f"{_title(z.name)} over {x.name} and {y.name}", note + remark)


def _gain_figures(results: Results, metric: str, start: str) -> list[tuple[str, Figure]]:
    """Speed relative to the stiff spine, where a grid varies the spine's phase, and its amplitude from 0."""
    names = columns_of(results, "varied")
    if metric != LEADING or not {"spine.amplitude", "spine.phase"} <= set(names):
        return []
    data = spine_ratio(results)
    varied = {name: quantity(results, name, data[name]) for name in names}
    x, y = varied.pop("spine.amplitude"), varied.pop("spine.phase")
    z = Quantity("speed relative to the stiff spine", "%", 100 * (data["ratio"] - 1))
    bends = x.values > 0
    if not np.isfinite(z.values[bends]).any() or len(np.unique(y.values)) < 2:
        return []
    panels, remark = _panels([other for other in varied.values() if len(np.unique(other.values)) > 1], len(z.values))
    title, note = f"Speed gain over {x.name} and {y.name}", f"{start}{remark}stiff: mean at {x.name} 0; "
    figure = heat_maps(x, y, z, panels, title, note, gain=bends)
    return [(f"{metric}-gain-over-{x.name}-and-{y.name}", figure)]


def _scatter_figures(drawn: list[Quantity], z: Quantity, metric: str, remark: str) -> list[tuple[str, Figure]]:
    """The metric against each parameter, and over the pairs of those that matter most."""
    good = np.isfinite(z.values)
    drawn = [Quantity(x.name, x.unit, x.values[good], x.log) for x in drawn if len(np.unique(x.values[good])) > 1]
    z = Quantity(z.name, z.unit, z.values[good])
    if not drawn:
        return []
    still = np.ptp(z.values) == 0
    influence = [0.0 if still else float(stats.spearmanr(x.values, z.values).statistic) for x in drawn]
    order = np.argsort(-np.abs(influence), kind="stable")
    first = [drawn[i] for i in order[:MOST_PANELS]]
    titles = [f"rank correlation {influence[i]:+.2f}" for i in order[:MOST_PANELS]]
    note = f"{len(z.values):,} runs; line: running mean"
    if len(z.values) > MOST_POINTS:
        thin = np.linspace(0, len(z.values) - 1, MOST_POINTS).round().astype(int)
        thin = np.union1d(thin, [np.argmin(cost(z.name, z.values))])  # the best one is a star
        first = [dataclasses.replace(x, values=x.values[thin]) for x in first]
        z, note = dataclasses.replace(z, values=z.values[thin]), f"{MOST_POINTS:,} of {note}"
    note = remark + note
    if len(drawn) > MOST_PANELS:
        note += f"; the {MOST_PANELS} of {len(drawn)} parameters that matter most"
    figures = [(f"{metric}-over-each", scatters(first, z, titles, f"{_title(metric)} over each parameter", note))]
    if len(drawn) > 1:
        pairs = list(itertools.combinations(first[:MOST_PAIRED], 2))
        title = f"{_title(metric)} over pairs of the parameters that matter most"
        figures.append((f"{metric}-over-pairs", pair_scatters(pairs, z, title, note.partition("; line")[0] + "; ")))
    return figures


def _panels(rest: list[Quantity], count: int) -> tuple[list[tuple[str, np.ndarray]], str]:
    """The panels of a heat map of `count` points for the parameters not on its axes, and a remark about them."""
    if len(rest) == 1:
        panels, left_out = _slices(rest[0])
        return panels, f"{left_out} more values of {rest[0].name} not shown; " if left_out else ""
    remark = f"mean over {', '.join(other.name for other in rest)}; " if rest else ""
    return [("", np.full(count, True))], remark


def _slices(third: Quantity) -> tuple[list[tuple[str, np.ndarray]], int]:
    """A panel for each value of the third parameter, and how many values were left out."""
    values = np.unique(third.values)
    kept = values[np.unique(np.linspace(0, len(values) - 1, min(len(values), MOST_PANELS)).round().astype(int))]
    panels = [(f"{third.name} = {third.shown(value)}", third.values == value) for value in kept]
    return panels, len(values) - len(kept)


def _quantities(results: Results, names: Sequence[str]) -> list[Quantity]:
    return [quantity(results, name, values) for name, values in results.columns(names)]


def _title(metric: str) -> str:
    return metric.replace("_", " ").capitalize()
