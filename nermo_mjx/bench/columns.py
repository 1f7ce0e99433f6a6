"""The columns of each measurement's table: heading, key, format and scale."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple


class ShownColumn(NamedTuple):
    """A column of a table; figures are shown times `scale`."""

    heading: str
    key: str
    shape: str = "{}"
    scale: float = 1.0

    def cell(self, line: Mapping[str, Any]) -> str:
        """The text of a line's cell."""
        value = line.get(self.key)
        if value is None:
            return "-"
        return self.shape.format(value if isinstance(value, str) or self.scale == 1.0 else value * self.scale)


_ENGINE, _WORLDS = ShownColumn("engine", "engine"), ShownColumn("worlds", "worlds", "{:,}")
_RATIO = ShownColumn("ratio", "ratio", "{:.2f}")
_TRACE, _COMPILE = ShownColumn("trace [s]", "trace_s", "{:.1f}"), ShownColumn("compile [s]", "compile_s", "{:.1f}")
_PEAK = ShownColumn("peak [MB]", "peak_bytes", "{:,.0f}", 1e-6)

#: Case -> its columns. For a case with several rows in a line (`ROWS`), the columns of these rows.
COLUMNS: Final[dict[str, tuple[ShownColumn, ...]]] = {
    "throughput": (
        _ENGINE, _WORLDS,
        ShownColumn("steps/s", "steps_per_second", "{:,.0f}"),
        ShownColumn("plain steps/s", "plain_steps_per_second", "{:,.0f}"),
        _RATIO,
        ShownColumn("loop's cost", "loop_cost", "{:.1%}"),
        ShownColumn("simulated s/s", "seconds_simulated_per_second", "{:,.0f}"),
        _TRACE, _COMPILE,
        ShownColumn("plain [s]", "plain_compile_s", "{:.1f}"),
        ShownColumn("carry [B/world]", "carry_bytes_per_world", "{:,}"),
        _PEAK,
    ),
    "gradient": (
        ShownColumn("mode", "mode"), _WORLDS,
        ShownColumn("cycles", "cycles", "{:g}"),
        ShownColumn("gradient [s]", "gradient_s", "{:.2f}"),
        ShownColumn("walk [s]", "forward_s", "{:.2f}"),
        _RATIO, _TRACE, _COMPILE,
        ShownColumn("kB/world", "temporary_bytes_per_world", "{:,.0f}", 1e-3),
        _PEAK,
    ),
    "tuning": (
        ShownColumn("trot [Hz]", "frequency", "{:g}"),
        ShownColumn("search", "search"),
        ShownColumn("from phase [rad]", "start_phase", "{:.2f}"),
        ShownColumn("amplitude [rad]", "amplitude", "{:.3f}"),
        ShownColumn("phase [rad]", "phase", "{:.2f}"),
        ShownColumn("speed [m/s]", "speed", "{:.4f}"),
        ShownColumn("of the best", "share", "{:.1%}"),
        ShownColumn("runs", "runs", "{:g}"),
        ShownColumn("wall [s]", "wall_s", "{:.0f}"),
    ),
    "search": (
        ShownColumn("trot [Hz]", "frequency", "{:g}"),
        ShownColumn("seed", "seed", "{:g}"),
        ShownColumn("amplitude [rad]", "amplitude", "{:.3f}"),
        ShownColumn("phase [rad]", "phase", "{:.2f}"),
        ShownColumn("speed [m/s]", "speed", "{:.4f}"),
        ShownColumn("of the best", "share", "{:.2%}"),
        ShownColumn("runs", "runs", "{:g}"),
        ShownColumn("to 99 %", "runs_to_99", "{:g}"),
        ShownColumn("wall [s]", "wall_s", "{:.1f}"),
    ),
    "gradients-pay": (
        ShownColumn("task", "task"), ShownColumn("gait", "gait"), ShownColumn("parameters", "parameters"),
        ShownColumn("method", "method"), ShownColumn("seed", "seed", "{:g}"),
        ShownColumn("CPU [s]", "cpu_s", "{:g}"),
        ShownColumn("to the first [CPU s]", "ready_cpu_s", "{:.0f}"),
        ShownColumn("evaluations", "evaluations", "{:,}"),
        ShownColumn("best", "best", "{:.3f}"), ShownColumn("unseen starts", "unseen", "{:.3f}"),
    ),
    "startup": (
        _ENGINE, _WORLDS, ShownColumn("cache", "cache"), ShownColumn("in all [s]", "total_s", "{:.1f}"),
        ShownColumn("import [s]", "import_s", "{:.1f}"),
        ShownColumn("model [s]", "model_s", "{:.1f}"),
        ShownColumn("parameters [s]", "parameters_s", "{:.1f}"),
        ShownColumn("open [s]", "open_s", "{:.1f}"),
        ShownColumn("first tick [s]", "first_tick_s", "{:.1f}"),
    ),
    "profile": (
        _ENGINE, _WORLDS, ShownColumn("stage", "stage"),
        ShownColumn("us a step", "us", "{:.2f}"), ShownColumn("share", "share", "{:.0%}"),
        ShownColumn("operations", "operations", "{:,}"), _TRACE, _COMPILE,
    ),
    "speedtest": (_WORLDS, ShownColumn("steps/s", "steps_per_second", "{:,.0f}"), _COMPILE, _PEAK),
    "gpu-plan": (
        ShownColumn("target", "target"), ShownColumn("program", "program"), _WORLDS, _TRACE, _COMPILE,
        ShownColumn("kB/world", "bytes_per_world", "{:,.1f}", 1e-3),
        ShownColumn("fits", "fits"),
        ShownColumn("launches per step", "launches_per_step", "{:,.0f}"),
        ShownColumn("a tick", "launches_per_tick", "{:,.0f}"),
        ShownColumn("library calls per step", "library_calls_per_step", "{:,.0f}"),
        ShownColumn("unknown loops", "unknown_loops"),
        ShownColumn("moved [kB/world/step]", "moved_bytes_per_step", "{:,.0f}", 1e-3),
        ShownColumn("launch bound [steps/s, estimate]", "estimated_launch_bound", "{:,.0f}"),
        ShownColumn("bandwidth bound [steps/s, estimate]", "estimated_bandwidth_bound", "{:,.0f}"),
        _PEAK,
    ),
}  # fmt: skip


def rows(line: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The table's rows for a measurement: one, or one for each part of it."""
    if "error" in line:
        return
    head = {key: value for key, value in line.items() if not isinstance(value, (list, dict))}
    if line["case"] == "startup":
        yield from ({**head, "cache": kind, "total_s": line[f"{kind}_s"], **line[kind]} for kind in ("cold", "warm"))
    elif line["case"] == "profile":
        yield from ({**head, **stage} for stage in line["stages"])
    elif line["case"] in ("tuning", "search"):
        yield from ({**head, **search} for search in line["searches"])
    elif line["case"] == "gradients-pay":
        found = line["found"]
        yield {**head, "best": line["curve"][-1][-1], "unseen": None if found is None else found["objective"]}
    else:
        yield head


def titled(line: Mapping[str, Any]) -> str | None:
    """A remark above the rows of a measurement; None if not needed."""
    if "error" in line:
        options = ", ".join(f"{key} {value}" for key, value in line.items() if key not in ("case", "error"))
        return f"{line['case']} ({options}) failed: {line['error']}"
    if line["case"] in ("tuning", "search"):
        dense = f"{line['dense_runs']} runs of a dense sweep reach {line['dense_speed']:.4f} m/s"
        more = f"{line['budget_runs']} runs for each search"
        if line["case"] == "search":
            found = f"median of the seeds {line['median_share']:.2%} in {line['median_wall_s']:.1f} s"
            more += f"; {found}; the published gait, where each begins, {line['published_share']:.2%}"
        return f"Trot at {line['frequency']:g} Hz: {dense}; {more}"
    return None
