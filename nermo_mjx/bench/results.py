"""The directory of results: results.jsonl with a line per run, and the page made from it, with its plots."""

from __future__ import annotations

import dataclasses
import json
import shlex
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator
from pydantic import BaseModel, ConfigDict

from nermo_mjx.bench import CASES
from nermo_mjx.files import MOST_ARRAYS, FileError, json_of, read_bytes
from nermo_mjx.plotting.charts import horizontal_grid, page
from nermo_mjx.plotting.files import Figures, write_figures
from nermo_mjx.plotting.style import BEST, INK, LINE, MUTED
from nermo_mjx.runs.files import DirectoryError, append_line, replace_file, table
from nermo_mjx.runs.status import Status

RESULTS: Final = "results.jsonl"
#: Heading of runs that ended before they could report their machine.
UNKNOWN: Final = "Unknown machine"
_COLOURS: Final = {"c": MUTED, "mjx": LINE, "warp": BEST}
#: Where logarithmic axes may begin and end.
_STEPS: Final = [step * 10.0**power for power in range(-4, 12) for step in (1, 2, 5)]


#: Figure -> heading of its column, its format, and the factor to the heading's unit.
_COLUMNS: Final[dict[str, tuple[str, str, float]]] = {
    "engine": ("engine", "{}", 1.0),
    "mode": ("mode", "{}", 1.0),
    "worlds": ("worlds", "{:,}", 1.0),
    "cache": ("cache", "{}", 1.0),
    "cycles": ("cycles", "{:g}", 1.0),
    "steps_per_second": ("steps/s", "{:,.0f}", 1.0),
    "plain_steps_per_second": ("plain steps/s", "{:,.0f}", 1.0),
    "gradient_s": ("gradient [s]", "{:.2f}", 1.0),
    "forward_s": ("walk [s]", "{:.2f}", 1.0),
    "ratio": ("ratio", "{:.2f}", 1.0),
    "loop_cost": ("loop's cost", "{:.1%}", 1.0),
    "seconds_simulated_per_second": ("simulated s/s", "{:,.0f}", 1.0),
    "trace_s": ("trace [s]", "{:.1f}", 1.0),
    "compile_s": ("compile [s]", "{:.1f}", 1.0),
    "plain_compile_s": ("plain [s]", "{:.1f}", 1.0),
    "temporary_bytes_per_world": ("kB/world", "{:,.0f}", 1e-3),
    "carry_bytes_per_world": ("carry [B/world]", "{:,}", 1.0),
    "peak_bytes": ("peak [MB]", "{:,.0f}", 1e-6),
    "total_s": ("to the first tick [s]", "{:.1f}", 1.0),
    **{
        f"{stage}_s": (f"{stage.replace('_', ' ')} [s]", "{:.1f}", 1.0)
        for stage in ("import", "model", "parameters", "open", "first_tick")
    },
    "training_s": ("then a training [s]", "{:.1f}", 1.0),
}
_COMPILING: Final = ("trace_s", "compile_s")
#: Case -> figures of its table.
COLUMNS: Final[dict[str, tuple[str, ...]]] = {
    "throughput": (
        *("engine", "worlds", "steps_per_second", "plain_steps_per_second", "ratio", "loop_cost"),
        *("seconds_simulated_per_second", *_COMPILING, "plain_compile_s", "carry_bytes_per_world", "peak_bytes"),
    ),
    "gradient": (
        *("mode", "worlds", "cycles", "gradient_s", "forward_s", "ratio", *_COMPILING),
        *("temporary_bytes_per_world", "peak_bytes"),
    ),
    "startup": (
        *("engine", "worlds", "cache", "total_s", "import_s", "model_s", "parameters_s", "open_s", "first_tick_s"),
        "training_s",
    ),
}


def table_of(case: str, lines: Sequence[Mapping[str, Any]]) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """(heading, "left" or "right") of each column of a case that has a figure, and the rows; failures have none."""
    found = [row for line in lines for row in _rows(line)]
    columns = {key: _COLUMNS[key] for key in COLUMNS[case] if any(row.get(key) is not None for row in found)}
    words = ("engine", "mode", "cache")

    def cell(value: Any, shape: str, factor: float) -> str:
        if value is None:
            return "-"
        return shape.format(value if isinstance(value, str) or factor == 1.0 else value * factor)

    return (
        [(heading, "left" if key in words else "right") for key, (heading, _, _) in columns.items()],
        [[cell(row.get(key), shape, factor) for key, (_, shape, factor) in columns.items()] for row in found],
    )


def _rows(line: Mapping[str, Any]) -> Iterator[Mapping[str, Any]]:
    """The table's rows for a measurement: one, or of a start one for each state of the cache."""
    if "error" in line:
        return
    if line["case"] != "startup":
        yield line
        return
    for cache in ("cold", "warm"):
        yield {**line, "cache": cache, "total_s": line[f"{cache}_s"], **line[cache]}


def failure_of(line: Mapping[str, Any]) -> str | None:
    """A sentence on a measurement that failed; None if it did not."""
    if "error" not in line:
        return None
    options = ", ".join(f"{key} {value}" for key, value in line.items() if key not in ("case", "error", "made", "day"))
    return f"{line['case']} ({options}) failed: {line['error']}"


@dataclasses.dataclass
class Measured:
    """The results of one measurement on one machine.

    Attributes:
        case: its name.
        good: its newest line with figures, and in `made` when it was measured and with what; None if there is none.
        failed: the latest line with an error, if that is newer.
    """

    case: str
    good: dict[str, Any] | None = None
    failed: dict[str, Any] | None = None

    def failure(self) -> str | None:
        """A sentence on the failure, its date and the date of the figures; None without a failure."""
        if self.failed is None:
            return None
        figures = f"; the figures are of {self.good['day']}" if self.good else ""
        return f"{str(failure_of(self.failed)).rstrip('.')}. That was on {self.failed['made']}{figures}."


class _Run(BaseModel, extra="allow"):
    """A line of results.jsonl, as far as it is read."""

    date: str
    commit: str | None
    hardware: dict[str, str | float | None] | None
    cases: list[Any]


class _Line(BaseModel):
    """A measurement in it: figures, of a start also those of its stages."""

    __pydantic_extra__: dict[str, str | float | bool | None]
    model_config = ConfigDict(extra="allow")
    case: str
    engine: str = ""
    error: str = ""
    cold: dict[str, float | None] | None = None
    warm: dict[str, float | None] | None = None


@dataclasses.dataclass(frozen=True)
class History:
    """The contents of results.jsonl.

    Attributes:
        machines: machine -> its measurements, in the order of `CASES`.
        remarks: a sentence about each line that is not shown.
        lines: readable measurements in the file, of any age.
        commits: measured ones, oldest first.
    """

    machines: dict[str, list[Measured]]
    remarks: tuple[str, ...]
    lines: int
    commits: tuple[str, ...]


def append(path: Path, run: Mapping[str, Any]) -> None:
    """Append a run, see `run_bench`, to a file as one line; existing lines are unchanged."""
    append_line(path, json.dumps(run))


def read(folder: Path) -> History:
    """The content of FOLDER/results.jsonl; unreadable lines become remarks.

    Raises:
        OSError: the file does not exist or cannot be read.
    """
    found: dict[str, dict[tuple[Any, ...], Measured]] = {}
    unreadable, remarks, commits, count = list[str](), list[str](), dict[str, None](), 0
    for number, text in enumerate(read_bytes(folder / RESULTS, MOST_ARRAYS).splitlines(), 1):
        try:
            run = json_of(text, _Run, RESULTS)
            about, day = run["hardware"], run["date"][:10]
            machine = f"{about['device']}; {about['cores']} x {about['cpu']}" if about else UNKNOWN
            versions = [f"{name} {about[name]}" for name in ("mujoco", "jax", "python")] if about else []
        except (FileError, KeyError):
            unreadable.append(str(number))
            continue
        commits[str(run["commit"])] = None
        for line in run["cases"]:
            name = str(line.get("case")) if isinstance(line, dict) else "None"
            try:
                wrong = "" if name in CASES else "this version does not know"
                wrong or list(_rows(json_of(json.dumps(line), _Line, RESULTS)))
            except (FileError, KeyError, TypeError):
                wrong = "cannot be read"
            if wrong:
                remarks.append(f"Line {number} of {RESULTS} has a case {name!r} that {wrong}; it is not shown.")
                continue
            count += 1
            # A line from before an option existed was made with the option's first default.
            key = tuple(line.get(name, option.default[0]) for name, option in CASES[name].options.items())
            known = found.setdefault(machine, {}).setdefault((list(CASES).index(name), *key), Measured(name))
            line = {**line, "made": ", ".join([day, f"commit {run['commit']}", *versions]), "day": day}
            if "error" in line:
                known.failed = line
            else:
                known.good, known.failed = line, None
    if unreadable:
        *most, last = unreadable
        named = f"Lines {', '.join(most)} and {last}" if most else f"Line {last}"
        remarks.insert(0, f"{named} of {RESULTS} cannot be read, and {'are' if most else 'is'} not shown.")

    def order(key: tuple[Any, ...]) -> list[Any]:
        return [(0, part) if isinstance(part, (int, float)) else (1, str(part)) for part in key]

    machines = {
        machine: [found[machine][key] for key in sorted(found[machine], key=order)]
        for machine in sorted(found, key=lambda machine: machine == UNKNOWN)
    }
    return History(machines, tuple(remarks), count, tuple(commits))


def status(out: Path) -> Status:
    """Status of a directory of benchmarks: the content of results.jsonl; its code is the measured commits."""
    history = read(out) if (out / RESULTS).exists() else History({}, (), 0, ())
    measured = [each for machine in history.machines.values() for each in machine]
    engines = dict.fromkeys(each.good["engine"] for each in measured if each.good and "engine" in each.good)
    notes = [f"{machine}: {len(each)} kinds of measurement." for machine, each in history.machines.items()]
    notes += [*history.remarks, *(failure for each in measured if (failure := each.failure()))]
    go_on = f"nermo-mjx bench --into {shlex.quote(str(out))}"
    engine = ", ".join(engines) or None
    count = history.lines
    return Status("measurements", count, count, count > 0, go_on, engine, code=history.commits, notes=tuple(notes))


def draw_page(folder: Path, write: Callable[[Path, bytes], None] = replace_file) -> None:
    """Remake FOLDER/results.md and its plots from FOLDER/results.jsonl.

    Args:
        write: how page and plots are written; by default they replace existing ones.
    """
    history = read(folder)
    text = ["# Results", "", "Made by `nermo-mjx bench --into`; the newest measurement of each kind counts.", ""]
    for remark in history.remarks:
        text += [remark, ""]
    for number, (machine, measured) in enumerate(history.machines.items(), 1):
        text += [f"## {machine}", ""]
        for case in dict.fromkeys(each.case for each in measured):
            own = [each for each in measured if each.case == case]
            good = [each.good for each in own if each.good]
            text += [f"### {case.capitalize()}: {CASES[case].about}", ""]
            text += [f"- {failure}" for each in own if (failure := each.failure())]
            columns, cells = table_of(case, good)
            if cells:
                text += ["", table([heading for heading, _ in columns], cells)]
                text += [f"Measured {'; '.join(dict.fromkeys(line['made'] for line in good))}."]
            text += [""]
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
    return (figure for number, (machine, measured) in machines for figure in _figures(machine, measured, number))


def _figures(machine: str, measured: Sequence[Measured], number: int) -> Iterator[tuple[str, Figure]]:
    """Throughput and memory over the batch, compile times, and the cost of gradients over the length of a walk."""

    def lines_with(case: str, *keys: str) -> list[Mapping[str, Any]]:
        """The lines of a case that have all these figures, and all its options."""
        lines = [each.good for each in measured if each.case == case and each.good]
        return [line for line in lines if all(line.get(name) is not None for name in (*CASES[case].options, *keys))]

    if walks := lines_with("throughput", "steps_per_second", "plain_steps_per_second", "peak_bytes"):
        yield f"throughput_{number}", _throughput(machine, walks)
    compiled = lines_with("throughput", "trace_s", "compile_s", "plain_trace_s", "plain_compile_s")
    if compiled := [line for line in compiled if line["compile_s"]]:
        yield f"compile_{number}", _compile(machine, compiled)
    gradients = lines_with("gradient", "ratio", "temporary_bytes_per_world")
    if len({line["cycles"] for line in gradients}) > 1:  # a curve needs more than one length
        yield f"gradient_{number}", _gradient(machine, gradients)


def _throughput(machine: str, walks: Sequence[Mapping[str, Any]]) -> Figure:
    figure = page(
        "Throughput and memory over the batch", 7.0, 3.2, f"{machine}. Dashed: plain physics of the same model."
    )
    speed, memory = figure.subplots(1, 2)
    for engine in dict.fromkeys(line["engine"] for line in walks):
        lines, colour = [line for line in walks if line["engine"] == engine], _COLOURS.get(engine, INK)
        _curve(speed, lines, "worlds", "steps_per_second", color=colour, label=engine)
        _curve(speed, lines, "worlds", "plain_steps_per_second", color=colour, marker="", ls="--", lw=1)
        _curve(memory, lines, "worlds", "peak_bytes", 1e-9, color=colour)
    sizes = sorted({line["worlds"] for line in walks})
    for ax, label in ((speed, "throughput [physics steps/s]"), (memory, "peak memory [GB]")):
        ax.set(xscale="log", yscale="log", xlabel="batch [worlds]", ylabel=label)
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


def _curve(ax: Axes, lines: Sequence[Mapping[str, Any]], x: str, y: str, scale: float = 1.0, **look: Any) -> None:
    """A figure of the lines over one of their options."""
    lines = sorted(lines, key=lambda line: line[x])
    look.setdefault("marker", "o")
    ax.plot([line[x] for line in lines], [line[y] * scale for line in lines], ms=3, **look)


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
        of_mode = [line for line in lines if line["mode"] == mode]
        _curve(ratio, of_mode, "cycles", "ratio", color=colour, label=mode)
        _curve(memory, of_mode, "cycles", "temporary_bytes_per_world", 1e-6, color=colour)
    ratio.set(xlabel="length of the walk [gait cycles]", ylabel="time over the walk's alone [1]", ylim=(0, None))
    memory.set(xlabel="length of the walk [gait cycles]", ylabel="memory of a world [MB]", ylim=(0, None))
    for ax in (ratio, memory):
        horizontal_grid(ax)
    ratio.legend()
    return figure
