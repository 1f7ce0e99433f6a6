"""The page of results: all runs in a directory, as tables by machine, and their plots."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from nermo_mjx.bench import paying_page
from nermo_mjx.bench.columns import COLUMNS, rows, titled
from nermo_mjx.bench.history import RESULTS, History, Measured, append, read
from nermo_mjx.bench.registry import CASES
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.page import page
from nermo_mjx.plotting.style import BEST, INK, LINE, MUTED, horizontal_grid
from nermo_mjx.runs.files import DirectoryError, replace_file
from nermo_mjx.runs.text import table

_COLOURS = {"c": MUTED, "mjx": LINE, "warp": BEST}
#: Where logarithmic axes may begin and end.
_STEPS = [step * 10.0**power for power in range(-4, 12) for step in (1, 2, 5)]


def add_run(folder: Path, run: Mapping[str, Any], write: Callable[[Path, bytes], None] = replace_file) -> None:
    """Append a run of `run_bench` to FOLDER/results.jsonl, and draw the page, see `draw_page`."""
    append(folder, run)
    draw_page(folder, write)


def draw_page(folder: Path, write: Callable[[Path, bytes], None] = replace_file) -> None:
    """Remake FOLDER/results.md and its plots from FOLDER/results.jsonl, and the page of a case that has its own.

    Args:
        write: how pages and plots are written; by default they replace existing ones.
    """
    history = read(folder)
    if searches := _searches(history):
        write_figures(paying_page.figures(searches), folder / "plots", write)
        write(folder / paying_page.PAGE, paying_page.text(searches).encode())
    text = ["# Results", "", "Made by `nermo-mjx bench --into`; the newest measurement of each kind counts.", ""]
    for remark in history.remarks:
        text += [remark, ""]
    for number, (machine, measured) in enumerate(history.machines.items(), 1):
        text += [f"## {machine}", "", *_tables(measured)]
        for path in write_figures(_figures(machine, measured, number), folder / "plots", write):
            if path.suffix == ".png":
                text += [f"![{path.stem.removesuffix(f'_{number}')}](plots/{path.name})", ""]
    write(folder / "results.md", ("\n".join(text).rstrip() + "\n").encode())


def figures(out: Path) -> Figures:
    """The figures of a directory of benchmarks.

    Raises:
        DirectoryError: results.jsonl cannot be read.
    """
    try:
        history = read(out)
    except OSError as error:
        raise DirectoryError(f"{out / RESULTS} cannot be read: {error.strerror}.") from None
    if not history.machines:
        raise DirectoryError(f"{out / RESULTS} cannot be read: no line of it is a run. Measure with nermo-mjx bench.")
    machines = enumerate(history.machines.items(), 1)
    own = (figure for number, (machine, measured) in machines for figure in _figures(machine, measured, number))
    return itertools.chain(own, paying_page.figures(_searches(history)))


def _searches(history: History) -> list[Mapping[str, Any]]:
    """Searches of the case that has a page of its own."""
    return [each.good for measured in history.machines.values() for each in measured
            if each.case == "gradients-pay" and each.good]  # fmt: skip


def _tables(measured: Sequence[Measured]) -> Iterator[str]:
    """Markdown: for each case its sentence, what failed, its table, and when it was measured."""
    for case in dict.fromkeys(each.case for each in measured):
        own = [each for each in measured if each.case == case]
        good = [each.good for each in own if each.good]
        found = [row for line in good for row in rows(line)]
        yield f"### {case.capitalize()}: {CASES[case].about}"
        yield ""
        yield from (f"- {title}" for line in good if (title := titled(line)))
        yield from (f"- {failure}" for each in own if (failure := each.failure()))
        if found:
            shown = [column for column in COLUMNS[case] if any(row.get(column.key) is not None for row in found)]
            cells = ([column.cell(row) for column in shown] for row in found)
            yield from ("", table([column.heading for column in shown], cells))
            yield f"Measured {'; '.join(dict.fromkeys(line['made'] for line in good))}."
        yield ""


def _figures(machine: str, measured: Sequence[Measured], number: int) -> Iterator[tuple[str, Figure]]:
    """Throughput and memory over the batch, compile times, and the cost of gradients over the length of a walk."""
    lines = [each.good for each in measured if each.good]
    walks = _with(lines, "throughput", "steps_per_second", "plain_steps_per_second", "peak_bytes")
    if walks:
        yield f"throughput_{number}", _throughput(machine, walks)
    compiled = _with(lines, "throughput", "trace_s", "compile_s", "plain_trace_s", "plain_compile_s")
    if compiled := [line for line in compiled if line["compile_s"]]:
        yield f"compile_{number}", _compile(machine, compiled)
    gradients = _with(lines, "gradient", "ratio", "temporary_bytes_per_world")
    if len({line["cycles"] for line in gradients}) > 1:  # a curve needs more than one length
        yield f"gradient_{number}", _gradient(machine, gradients)


def _with(lines: Sequence[Mapping[str, Any]], case: str, *figures: str) -> list[Mapping[str, Any]]:
    """The lines of a case that have all these figures, and all its options."""
    needed = (*CASES[case].options, *figures)
    return [line for line in lines if line["case"] == case and all(line.get(name) is not None for name in needed)]


def _throughput(machine: str, walks: Sequence[Mapping[str, Any]]) -> Figure:
    figure = page(
        "Throughput and memory over the batch", 7.0, 3.2, f"{machine}. Dashed: plain physics of the same model."
    )
    speed, memory = figure.subplots(1, 2)
    for engine in dict.fromkeys(line["engine"] for line in walks):
        own = sorted((line for line in walks if line["engine"] == engine), key=lambda line: line["worlds"])
        worlds, colour = [line["worlds"] for line in own], _COLOURS.get(engine, INK)
        speed.plot(worlds, [line["steps_per_second"] for line in own], "o-", ms=3, color=colour, label=engine)
        speed.plot(worlds, [line["plain_steps_per_second"] for line in own], "--", lw=1, color=colour)
        memory.plot(worlds, [line["peak_bytes"] / 1e9 for line in own], "o-", ms=3, color=colour, label=engine)
    for ax, label in ((speed, "throughput [physics steps/s]"), (memory, "peak memory [GB]")):
        ax.set(xscale="log", yscale="log", xlabel="batch [worlds]", ylabel=label)
        sizes = sorted({line["worlds"] for line in walks})
        ax.set_xticks(sizes, [f"{size:,}" for size in sizes])
        ax.xaxis.set_minor_locator(NullLocator())
        ax.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.10g}"))
        ax.yaxis.set_minor_locator(NullLocator())
        low, high = ax.get_ylim()
        ax.set_ylim(max(step for step in _STEPS if step <= low), min(step for step in _STEPS if step >= high))
        horizontal_grid(ax)
    speed.legend()
    return figure


def _compile(machine: str, walks: Sequence[Mapping[str, Any]]) -> Figure:
    figure = page("From Python to a program", 7.0, 1.8 + 0.45 * len(walks), f"{machine}. Cold cache.")
    ax = figure.subplots()
    names = [f"{line['engine']}, {line['worlds']:,} worlds" for line in walks]
    trace, compiled = ([line[key] for line in walks] for key in ("trace_s", "compile_s"))
    ax.barh(names, trace, color=MUTED, label="trace")
    ax.barh(names, compiled, left=trace, color=LINE, label="compile")
    plain = [line["plain_trace_s"] + line["plain_compile_s"] for line in walks]
    ax.plot(plain, names, "|", ms=14, color=BEST, label="plain physics, both")
    ax.set(xlabel="time [s]")
    ax.margins(y=0.3)
    ax.invert_yaxis()
    ax.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3)
    return figure


def _gradient(machine: str, lines: Sequence[Mapping[str, Any]]) -> Figure:
    figure = page("What a gradient costs over the length of a walk", 7.0, 3.2, f"{machine}.")
    ratio, memory = figure.subplots(1, 2)
    for mode, colour in (("forward", LINE), ("reverse", BEST)):
        own = sorted((line for line in lines if line["mode"] == mode), key=lambda line: line["cycles"])
        cycles = [line["cycles"] for line in own]
        ratio.plot(cycles, [line["ratio"] for line in own], "o-", ms=3, color=colour, label=mode)
        memory.plot(cycles, [line["temporary_bytes_per_world"] / 1e6 for line in own], "o-", ms=3, color=colour)
    ratio.set(xlabel="length of the walk [gait cycles]", ylabel="time over the walk's alone [1]", ylim=(0, None))
    memory.set(xlabel="length of the walk [gait cycles]", ylabel="memory of a world [MB]", ylim=(0, None))
    for ax in (ratio, memory):
        horizontal_grid(ax)
    ratio.legend()
    return figure
