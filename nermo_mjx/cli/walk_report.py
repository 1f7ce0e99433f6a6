"""The terminal summary of one run: millimetres and degrees, where the metrics are in metres and radians."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from nermo_mjx.cli.output import print_table

if TYPE_CHECKING:
    from nermo_mjx.cli.walk_plan import Plan

ANGLES = ("roll", "pitch", "yaw")
#: Other lines of the table: metric, how it is called, its unit, and the factor from SI.
LINES = (
    ("distance", "distance", "mm", 1e3),
    ("duration", "measured time", "s", 1.0),
    ("lateral_drift", "lateral drift", "mm", 1e3),
    ("slip", "slip of loaded feet", "mm/s", 1e3),
    ("servo_work", "servo work", "J", 1.0),
    ("cost_of_transport", "cost of transport", "", 1.0),
)


def print_walk(report: dict[str, Any], plan: Plan, files: list[Path]) -> None:
    """Print a report of what `walk` had planned."""
    from nermo_mjx.rollout.metrics import Ending

    metrics, setup = report["metrics"], report["setup"]
    how = setup["controller"] or f"{setup['gait']} at {report['parameters']['frequency']:g} Hz, spine {setup['spine']}"
    what = f"{how}, {setup['tail']} tail, engine {report['engine']}"
    lines = [("speed", metrics.get("speed"), "mm/s", 1e3)]
    if math.isfinite(theory := plan.theory):
        lines.append(("speed in theory", theory, "mm/s", 1e3))
    lines += [(title, metrics[name], unit, factor) for name, title, unit, factor in LINES if name in metrics]
    rows = [[title, _shown(value, factor), unit] for title, value, unit, factor in lines]
    rows += [[own.name, f"{metrics[own.name]:.4g}", own.unit] for own in plan.setup.own_metrics]
    headings = [("", "left"), ("", "right"), ("", "left")]
    ratio = report["parameters"].get("tracking.clock_ratio", 1.0)
    if ratio != 1.0:
        # Seconds of the controller's clock, in which frequencies are given, before simulated ones.
        scaled = {"mm/s": ratio, "s": 1.0 / ratio}
        for row, (_, value, unit, factor) in zip(rows, lines, strict=False):
            row.insert(1, _shown(value, factor * scaled.get(unit, 1.0)))
        for row in rows[len(lines) :]:
            row.insert(1, "")
        headings = [("", "left"), ("controller's clock", "right"), ("simulated", "right"), ("", "left")]
    print_table(f"Nermo walked: {what}", headings, rows)
    degrees = math.degrees(1.0)
    parts = ("mean", "std", "min", "max")
    angles = [[angle, *(_shown(metrics.get(f"{angle}_{part}"), degrees) for part in parts)] for angle in ANGLES]
    print_table("Orientation [degrees]", [("", "left"), *((part, "right") for part in parts)], angles)
    ending = Ending[metrics["status"]]
    if ending is not Ending.ok:
        click.echo(ending.value)
    for file in files:
        click.echo(f"wrote {file}")


def _shown(value: float | None, factor: float) -> str:
    if value is None or not math.isfinite(value):
        return "-"
    value *= factor
    return f"{value:.1f}" if abs(value) >= 10 else f"{value:.2f}"
