"""What the tables of each measurement show: heading, key, format and scale of every column."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final, NamedTuple


class Column(NamedTuple):
    """A column of a table; figures are shown times `scale`."""

    heading: str
    key: str
    shape: str = "{}"
    scale: float = 1.0

    def cell(self, line: Mapping[str, Any]) -> str:
        """What stands in a line's cell."""
        value = line.get(self.key)
        if value is None:
            return "-"
        return self.shape.format(value if isinstance(value, str) or self.scale == 1.0 else value * self.scale)


_ENGINE, _WORLDS = Column("engine", "engine"), Column("worlds", "worlds", "{:,}")
_RATIO = Column("ratio", "ratio", "{:.2f}")
_TRACE, _COMPILE = Column("trace [s]", "trace_s", "{:.1f}"), Column("compile [s]", "compile_s", "{:.1f}")
_PEAK = Column("peak [MB]", "peak_bytes", "{:,.0f}", 1e-6)

#: Case -> its columns. Those of a case that has rows of its own in a line (`ROWS`) are of these rows.
COLUMNS: Final[dict[str, tuple[Column, ...]]] = {
    "throughput": (
        _ENGINE, _WORLDS,
        Column("steps/s", "steps_per_second", "{:,.0f}"),
        Column("plain steps/s", "plain_steps_per_second", "{:,.0f}"),
        _RATIO,
        Column("loop's cost", "loop_cost", "{:.1%}"),
        Column("simulated s/s", "seconds_simulated_per_second", "{:,.0f}"),
        _TRACE, _COMPILE,
        Column("plain [s]", "plain_compile_s", "{:.1f}"),
        Column("carry [B/world]", "carry_bytes_per_world", "{:,}"),
        _PEAK,
    ),
    "gradient": (
        Column("mode", "mode"), _WORLDS,
        Column("cycles", "cycles", "{:g}"),
        Column("gradient [s]", "gradient_s", "{:.2f}"),
        Column("walk [s]", "forward_s", "{:.2f}"),
        _RATIO, _TRACE, _COMPILE,
        Column("kB/world", "temporary_bytes_per_world", "{:,.0f}", 1e-3),
        _PEAK,
    ),
    "tuning": (
        Column("trot [Hz]", "frequency", "{:g}"),
        Column("search", "search"),
        Column("from phase [rad]", "start_phase", "{:.2f}"),
        Column("amplitude [rad]", "amplitude", "{:.3f}"),
        Column("phase [rad]", "phase", "{:.2f}"),
        Column("speed [m/s]", "speed", "{:.4f}"),
        Column("of the best", "share", "{:.1%}"),
        Column("runs", "runs", "{:g}"),
        Column("wall [s]", "wall_s", "{:.0f}"),
    ),
    "startup": (
        _ENGINE, _WORLDS, Column("cache", "cache"), Column("in all [s]", "total_s", "{:.1f}"),
        Column("import [s]", "import_s", "{:.1f}"),
        Column("model [s]", "model_s", "{:.1f}"),
        Column("parameters [s]", "parameters_s", "{:.1f}"),
        Column("open [s]", "open_s", "{:.1f}"),
        Column("first tick [s]", "first_tick_s", "{:.1f}"),
    ),
    "profile": (
        _ENGINE, _WORLDS, Column("stage", "stage"),
        Column("us a step", "us", "{:.2f}"), Column("share", "share", "{:.0%}"),
        Column("operations", "operations", "{:,}"), _TRACE, _COMPILE,
    ),
    "speedtest": (_WORLDS, Column("steps/s", "steps_per_second", "{:,.0f}"), _COMPILE, _PEAK),
    "gpu-plan": (
        Column("target", "target"), Column("program", "program"), _WORLDS, _TRACE, _COMPILE,
        Column("kB/world", "bytes_per_world", "{:,.1f}", 1e-3),
        Column("fits", "fits"),
        Column("launches a step", "launches_per_step", "{:,.0f}"),
        Column("a tick", "launches_per_tick", "{:,.0f}"),
        Column("library calls a step", "library_calls_per_step", "{:,.0f}"),
        Column("unknown loops", "unknown_loops"),
        Column("moved [kB/world/step]", "moved_bytes_per_step", "{:,.0f}", 1e-3),
        Column("launch bound [steps/s, estimate]", "estimated_launch_bound", "{:,.0f}"),
        Column("bandwidth bound [steps/s, estimate]", "estimated_bandwidth_bound", "{:,.0f}"),
        _PEAK,
    ),
}  # fmt: skip


def rows(line: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """The table's rows that a measurement makes: one, or one for each part of it."""
    if "error" in line:
        return
    head = {key: value for key, value in line.items() if not isinstance(value, (list, dict))}
    if line["case"] == "startup":
        yield from ({**head, "cache": kind, "total_s": line[f"{kind}_s"], **line[kind]} for kind in ("cold", "warm"))
    elif line["case"] == "profile":
        yield from ({**head, **stage} for stage in line["stages"])
    elif line["case"] == "tuning":
        yield from ({**head, **search} for search in line["searches"])
    else:
        yield head


def titled(line: Mapping[str, Any]) -> str | None:
    """What must be said of a measurement above its rows; None if they say all."""
    if "error" in line:
        options = ", ".join(f"{key} {value}" for key, value in line.items() if key not in ("case", "error"))
        return f"{line['case']} ({options}) failed: {line['error']}"
    if line["case"] == "tuning":
        dense = f"{line['dense_runs']} runs of a dense sweep reach {line['dense_speed']:.4f} m/s"
        return f"Trot at {line['frequency']:g} Hz: {dense}; {line['budget_runs']} runs for each search"
    return None
