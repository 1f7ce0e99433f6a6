"""Figures of a comparison, from its table alone: differences by metric, and the gain of one metric by groups."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter

from nermo_mjx.plotting.files import Figures
from nermo_mjx.plotting.page import Page
from nermo_mjx.plotting.shown import ShownValues, shown
from nermo_mjx.plotting.style import BEST, GRID, INK, LINE, MUTED, SERIES, horizontal_grid, set_scales
from nermo_mjx.sweep.figures import titled
from nermo_mjx.sweep.spec import OBJECTIVES
from nermo_mjx.sweep.table import columns_of, meta, report_table

Row = Mapping[str, Any]
#: Metrics of one figure, and panels.
_MOST_METRICS: Final = 30
_MOST_PANELS: Final = 12
#: Relative differences beyond this are cut off in the figure, if there are others [fraction].
_FAR: Final = 1.0
_MARKS: Final = "filled: beyond noise; hollow: within it; bars: 95 % intervals"


def figures_of(table: pa.Table) -> Iterator[tuple[str, Figure]]:
    """(file name, figure) of a comparison's table, for each other side; by groups, of the metrics that it names."""
    about = table.schema.metadata or {}
    base, metrics = about[b"comparison"].decode(), about[b"drawn"].decode().split()
    groups = columns_of(table, "varied")
    lines = table.to_pylist()
    for other in dict.fromkeys(line["other"] for line in lines):
        own = [line for line in lines if line["other"] == other]
        # Directories may have long names, and one figure is of two values of a column at most.
        against = f"{about.get(b'by', b'').decode()} {_last(other)} against {_last(base)}".lstrip()
        tail = "" if len({line["other"] for line in lines}) == 1 else f"-{_last(other)}"
        yield f"differences{tail}", _forest([line for line in own if line["group"] < 0], against)
        for metric in metrics if groups else ():
            rows = [line for line in own if line["group"] >= 0 and line["metric"] == metric]
            yield f"{metric}-gain-by-{'-and-'.join(groups)}{tail}", _by_groups(rows, table.schema, groups, against)


def figures(out: Path) -> Figures:
    """The figures of a comparison's directory.

    Raises:
        DirectoryError: its table is absent or damaged.
    """
    return figures_of(report_table(out, "comparison"))


def _forest(rows: Sequence[Row], against: str) -> Figure:
    """The relative difference of each metric with its interval, and in numbers beside it."""
    known = [row for row in rows if row["relative"] is not None and np.isfinite(row["relative"])]
    listed = [row for row in known if row["metric"] in OBJECTIVES or row["beyond_noise"]] or known
    drawn = sorted(listed, key=lambda row: row["metric"] not in OBJECTIVES)[:_MOST_METRICS]
    page = Page(f"Relative differences: {against}", (7.6, 0.24 * len(drawn) + 1.5))
    ax = page.axes[0, 0]
    # An outlier would leave the others no room.
    ends = np.abs([[row["relative_low"], row["relative_high"]] for row in drawn] or [[0.1, 0.1]])
    far = float(min(max(1.12 * np.nanmax(ends, initial=0.02), 0.02), _FAR))
    ax.axvline(0, color=MUTED, lw=0.8)
    for place, row in enumerate(drawn):
        low, middle, high = (float(row[name]) for name in ("relative_low", "relative", "relative_high"))
        colour = _colour(row)
        ax.plot(np.clip([low, high], -far, far), [place, place], color=colour, lw=1.4, solid_capstyle="butt")
        out = abs(middle) > far
        ax.plot(np.clip(middle, -far, far), place, marker=("<" if middle < 0 else ">") if out else "o", ms=5.5,
                color=colour, mfc=colour if row["beyond_noise"] else "white", clip_on=False)  # fmt: skip
        about = "no interval" if np.isnan(low) else f"[{_percent(low)}, {_percent(high)}]"
        ax.text(1.02, place, f"{_percent(middle)} %  {about}", transform=ax.get_yaxis_transform(), va="center",
                fontsize=8, color=INK if row["beyond_noise"] else MUTED)  # fmt: skip
    ax.set_yticks(range(len(drawn)), [row["metric"] for row in drawn])
    ax.set(ylim=(len(drawn) - 0.4, -0.6), xlim=(-far, far), xlabel="difference relative to the base's mean [%]")
    ax.xaxis.set_major_formatter(FuncFormatter(lambda value, _: _percent(value)))
    ax.grid(axis="x", color=GRID, lw=0.8)
    left = len(rows) - len(drawn)
    more = f"\n{left} more metrics are in the table" if left else ""
    handles = [_mark(LINE, "better"), _mark(BEST, "worse"), _mark(MUTED, "neither")]
    return page.finish(handles, f"{_MARKS}\n{_runs(rows)}{more}")


def _by_groups(rows: Sequence[Row], schema: pa.Schema, groups: Sequence[str], against: str) -> Figure:
    """The gain of one metric over the groups: one of their columns across, one as lines, the others as panels."""
    x, series, panels = _roles(rows, groups)
    relative = all(row["relative"] is not None and np.isfinite(row["relative"]) for row in rows)
    metric, unit = rows[0]["metric"], rows[0]["metric_unit"]
    names = ("relative", "relative_low", "relative_high") if relative else ("difference", "low", "high")
    numbers = shown(metric, unit, [[row[name] for name in names] for row in rows])
    values = 100 * np.array([[row[name] for name in names] for row in rows], float) if relative else numbers.values
    across = _column(schema, x, [row[x] for row in rows])
    parts = list(dict.fromkeys(tuple(row[name] for name in panels) for row in rows))[:_MOST_PANELS]
    each = list(dict.fromkeys(row[series] if series else None for row in rows))
    columns = min(len(parts), 3)
    page = Page(f"{titled(metric)}: {against}", (max(6.4, 3.3 * columns), 3.0 * -(-len(parts) // columns) + 1.0),
                -(-len(parts) // columns), columns, sharey=True)  # fmt: skip
    for ax in page.axes.ravel()[len(parts) :]:
        ax.remove()
    for ax, part in zip(page.axes.ravel(), parts, strict=False):
        for place, value in enumerate(each):
            own = [i for i, row in enumerate(rows) if tuple(row[name] for name in panels) == part
                   and (series is None or row[series] == value)]  # fmt: skip
            _line(ax, across, values, [rows[i]["beyond_noise"] for i in own], own, place, len(each))
        ax.set_title(", ".join(f"{name} {_text(value)}" for name, value in zip(panels, part, strict=True)))
        if isinstance(across, ShownValues):
            set_scales(ax, across)
        else:
            ax.set_xticks(range(len(across[0])), across[0])
        ax.axhline(0, color=MUTED, lw=0.8, zorder=1)
        horizontal_grid(ax)
    for ax in page.figure.axes:
        if (spec := ax.get_subplotspec()) is not None and spec.is_first_col():
            ax.set_ylabel(f"difference in {metric} [{'%' if relative else numbers.unit or 1}]")
        ax.set_xlabel(across.label if isinstance(across, ShownValues) else x)
    handles = [_mark(SERIES[i % len(SERIES)], f"{series} {_text(value)}") for i, value in enumerate(each) if series]
    return page.finish(handles, f"{_MARKS}\n{_runs(rows)}{_failures(rows, groups)}")


def _line(
    ax: Axes, across: ShownValues | tuple[list[str], np.ndarray], values: np.ndarray, beyond: Sequence[bool | None],
    own: Sequence[int], place: int, count: int,
) -> None:  # fmt: skip
    """One line with bars; lines stand a little apart, so that their bars do not cover each other."""
    positions = across.values if isinstance(across, ShownValues) else across[1]
    distinct = np.unique(positions)
    step = float(np.diff(distinct).min()) if len(distinct) > 1 else 1.0
    order = np.array(own)[np.argsort(positions[own], kind="stable")]
    log = isinstance(across, ShownValues) and across.log
    shift = 0.0 if log else (place - (count - 1) / 2) * 0.09 * step
    at, colour = positions[order] + shift, SERIES[place % len(SERIES)]
    middle, low, high = values[order].T
    ax.plot(at, middle, color=colour, lw=1.2 if isinstance(across, ShownValues) else 0, alpha=0.7, zorder=2)
    ax.vlines(at, low, high, color=colour, lw=1.6, zorder=3)
    hollow = {i: not flag for i, flag in zip(own, beyond, strict=True)}
    ax.scatter(at, middle, s=34, ec=colour, fc=["white" if hollow[i] else colour for i in order], lw=1.3, zorder=4)


def _roles(rows: Sequence[Row], groups: Sequence[str]) -> tuple[str, str | None, list[str]]:
    """Which columns give the x axis, the lines and the panels: numbers with many values give the x axis."""
    count = {name: len({row[name] for row in rows}) for name in groups}
    numbers = [name for name in groups if all(isinstance(row[name], float) for row in rows)]
    x = max(numbers or groups, key=count.__getitem__)
    rest = [name for name in groups if name != x]
    few = [name for name in rest if count[name] <= len(SERIES)]
    series = max(few, key=count.__getitem__) if few else None
    return x, series, [name for name in rest if name != series]


def _column(schema: pa.Schema, name: str, values: Sequence[Any]) -> ShownValues | tuple[list[str], np.ndarray]:
    """The values across as shown, or of a column of names these and their places."""
    if all(isinstance(value, float) for value in values):
        about = meta(schema.field(name))
        return shown(name, about["unit"], values, log=about.get("scale") == "log")
    names = list(dict.fromkeys(map(_text, values)))
    return names, np.array([names.index(_text(value)) for value in values], float)


def _colour(row: Row) -> str:
    if not row["better"] or not row["difference"]:
        return MUTED
    closer = abs(row["other_mean"]) < abs(row["base_mean"])
    gains = {"high": row["difference"] > 0, "low": row["difference"] < 0, "zero": closer}[row["better"]]
    return LINE if gains else BEST


def _mark(colour: str, label: str) -> Line2D:
    return Line2D([], [], color=colour, marker="o", ms=5.5, lw=1.4, label=label)


def _runs(rows: Sequence[Row]) -> str:
    """How many runs went into it, and how many of them failed."""
    groups = {row["group"]: row for row in rows}.values()
    base, other = (sum(max(own["runs_" + side] for own in rows if own["group"] == row["group"]) for row in groups)
                   for side in ("base", "other"))  # fmt: skip
    failed = [sum(row["failed_" + side] for row in groups) for side in ("base", "other")]
    fell = f"; {failed[0]} of the base and {failed[1]} of the other fell or were lost" if any(failed) else "; none fell"
    return f"{base:,} runs of the base, {other:,} of the other{fell}"


def _failures(rows: Sequence[Row], groups: Sequence[str]) -> str:
    """Where the most runs failed."""
    failed = sorted(((row["failed_base"] + row["failed_other"], row) for row in rows), key=lambda pair: -pair[0])
    told = [f"{', '.join(_text(row[name]) for name in groups)} ({count})" for count, row in failed[:4] if count]
    return f", most at {'; '.join(told)}" if told else ""


def _percent(share: float) -> str:
    """A share in percent with its sign."""
    percent = 100 * share
    text = f"{percent:+,.0f}" if abs(percent) >= 100 else f"{percent:+.3g}" if abs(percent) >= 10 else f"{percent:+.1f}"
    return ("0" if not round(percent, 1) else text).replace("-", "−")


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else str(value)


def _last(name: str) -> str:
    """The last part of a path."""
    return name.rstrip("/").rpartition("/")[2] or name
